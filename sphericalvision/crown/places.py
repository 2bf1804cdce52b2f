# SPDX-License-Identifier: Apache-2.0
"""The vertices at all places of a crown; values at these places, and the mean of each vertex over its places."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int, Num, Shaped
from torch import Tensor

from sphericalvision.icosphere import level_from_num_vertices, num_icosphere_vertices
from sphericalvision.icosphere.topology import chart_vertex_ids
from sphericalvision.tables import constant_table


def level_of_rectangles(col: Shaped[Tensor, "*batch long short"]) -> int:
    """Level of the icosphere of rectangles ``(*, 2n + 1, n + 1)``, where ``n = 2**level``."""
    return (col.shape[-1] - 1).bit_length() - 1


def own_charts(values: Shaped[Tensor, "B C *N V"], n: int) -> Shaped[Tensor, "B 5 C *N rows columns"]:
    """View ``(B, C, [N,] V)`` without the poles as the vertices that charts own, ``(B, 5, C, [N,] 2n, n)``."""
    return values[..., 1:-1].unflatten(-1, (5, 2 * n, n)).movedim(-3, 1)


@constant_table
def place_ids(level: int, device: torch.device | None = None) -> Int[Tensor, "10 places"]:
    """Vertices at the places of five col and then five row rectangles, ``(10, (2n + 1) * (n + 1))``.

    A col rectangle is a chart with all its borders. A row rectangle has in its western half the northern half of a
    chart, in its eastern half the southern half of the next one.
    """
    n, charts = 2**level, chart_vertex_ids(level, device)
    rows = torch.cat((charts[:, : n + 1], charts.roll(-1, 0)[:, n:, 1:]), -1)  # the column between is in both
    return torch.cat((charts.flatten(1), rows.flatten(1)))


def values_at_places(
    values: Num[Tensor, "B C *N V"],
) -> tuple[Num[Tensor, "B 5 C *N long short"], Num[Tensor, "B 5 C *N short long"]]:
    """Look values ``(B, C, [N,] V)`` up at all places: col ``(B, 5, C, [N,] 2n + 1, n + 1)`` and row rectangles."""
    level = level_from_num_vertices(values.shape[-1])
    return as_rectangles(values.index_select(-1, place_ids(level, values.device).flatten()), level)


def as_rectangles(
    places: Num[Tensor, "B C *N P"], level: int
) -> tuple[Num[Tensor, "B 5 C *N long short"], Num[Tensor, "B 5 C *N short long"]]:
    """View what is at the P places of ten rectangles, one after the other, as the rectangles, col and row."""
    n = 2**level
    col, row = places.unflatten(-1, (10, -1)).movedim(-2, 1).split(5, 1)
    return col.unflatten(-1, (2 * n + 1, n + 1)), row.unflatten(-1, (n + 1, 2 * n + 1))


def mean_over_places(
    col: Float[Tensor, "B 5 C *N long short"], row: Float[Tensor, "B 5 C *N short long"]
) -> Float[Tensor, "B C *N V"]:
    """Return the mean ``(B, C, [N,] V)`` of each vertex over all its places."""
    level = level_of_rectangles(col)
    columns = torch.cat((col.flatten(-2), row.flatten(-2)), 1).movedim(1, -2).flatten(-2)
    ids, size = place_ids(level, col.device).flatten(), num_icosphere_vertices(level)
    sums = columns.new_zeros((*columns.shape[:-1], size)).scatter_add(-1, ids.expand(columns.shape), columns)
    return sums / columns.new_zeros(size).index_add(0, ids, columns.new_ones(len(ids)))
