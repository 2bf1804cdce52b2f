# SPDX-License-Identifier: Apache-2.0
"""Point location for many directions: a table of cells instead of the way down for each of them."""

from __future__ import annotations

import torch
from torch import Tensor

from sphericalvision.icosphere.fast.triangle_table import coefficients, find_triangles, triangle_table

__all__ = ["chunk_size", "locate_many"]

#: Directions at once, which bounds the memory in use.
CHUNK, CHUNK_ON_DEVICE = 1 << 17, 1 << 22


def chunk_size(device: torch.device) -> int:
    """Return how many directions to locate at once: on a CPU so few that they stay in the cache.

    Examples:
        >>> chunk_size(torch.device("cpu")) >= 1 << 17
        True
    """
    # torch gives a thread at least 32768 numbers.
    return max(CHUNK, torch.get_num_threads() << 15) if device.type == "cpu" else CHUNK_ON_DEVICE


def locate_many(directions: Tensor, level: int) -> tuple[Tensor, Tensor]:
    """``locate`` for directions ``(M, 3)``, faster when there are more of them than vertices.

    Examples:
        >>> ids, weights = locate_many(torch.tensor([[0.0, -2.0, 0.0]]), level=1)
        >>> ids[0, weights[0].argmax()].item()
        0
    """
    rays = directions.to(torch.promote_types(directions.dtype, torch.float32))
    table = triangle_table(level, rays.dtype, rays.device)
    ids = torch.empty(rays.shape, dtype=torch.long, device=rays.device)
    triangles, weights = ids.new_empty(len(rays), dtype=torch.int32), torch.empty_like(rays)
    with torch.no_grad():
        size = chunk_size(rays.device)
        for start in range(0, len(rays), size):
            part = slice(start, start + size)
            triangles[part], shares = find_triangles(torch.stack(rays[part].unbind(1)), table)
            total = shares.sum(0)
            for corner, share in enumerate(shares):
                torch.div(share, total, out=weights[part, corner])
        torch.index_select(table.ids, 0, triangles, out=ids)
    if directions.requires_grad and torch.is_grad_enabled():
        shares = coefficients(rays.T, triangles, table)
        weights = (shares / shares.sum(0)).T.contiguous()
    return ids, weights.to(directions.dtype)
