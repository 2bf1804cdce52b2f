# SPDX-License-Identifier: Apache-2.0
"""Between the places of a crown and vertices: tables for operators, and the sum of each vertex over its places."""

from __future__ import annotations

from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor

from sphericalvision.crown.places import place_ids

__all__ = ["Pair", "over_places", "vertices_at_places"]

Pair = tuple[Tensor, Tensor]


def over_places(col: Tensor, row: Tensor, mean: bool) -> Tensor:
    """Sum each vertex over all its places, or take their mean.

    Args:
        col: ``(B, 5, N, h, w, C)``.
        row: ``(B, 5, N, w, h, C)``.
        mean: whether sums are divided by the number of places.

    Returns:
        ``(B, N, V, C)``.
    """
    starts, places = _places_of_vertices((col.shape[-2] - 1).bit_length() - 1)
    volumes = [x if x.stride(-1) == 1 else x.contiguous() for x in (y.flatten(0, 1) for y in (col, row))]
    total = col.new_empty(len(col), col.shape[2], 1, len(starts) - 1, col.shape[-1])
    torch.ops.sphericalvision.sum_over_places(*volumes, starts, places, mean, total)
    return total.squeeze(2)


@lru_cache(maxsize=16)
@torch.inference_mode(False)  # kept for training, too
def _places_of_vertices(level: int) -> Pair:
    """Where the places of each vertex begin, and these one after the other, int32 on the CPU."""
    vertices = place_ids(level, torch.device("cpu")).flatten()
    # A stable order, so that sums of a vertex are always added in the same order.
    starts = F.pad(vertices.bincount().cumsum(0), (1, 0))
    return starts.int(), vertices.argsort(stable=True).int()


@lru_cache(maxsize=16)
@torch.inference_mode(False)  # kept for training, too
def vertices_at_places(level: int) -> Pair:
    """Vertices at the places of col and of row rectangles, int32 on the CPU: at level 7 half a megabyte each."""
    n = 2**level
    col, row = place_ids(level, torch.device("cpu")).int().split(5)
    return col.view(5, 2 * n + 1, n + 1), row.view(5, n + 1, 2 * n + 1)
