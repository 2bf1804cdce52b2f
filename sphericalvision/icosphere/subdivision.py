# SPDX-License-Identifier: Apache-2.0
"""The order of vertices in plain midpoint subdivision, which other programs use, and values brought to and from it."""

from __future__ import annotations

import torch
from jaxtyping import Int, Shaped
from torch import Tensor

from sphericalvision.icosphere.topology import (
    check_level,
    coarse_vertex_ids,
    level_from_num_vertices,
    num_icosphere_vertices,
    vertex_at,
)


def subdivision_order(level: int, device: torch.device | str | None = None) -> Int[Tensor, " V"]:
    """Return, for each vertex, its index in the order of plain midpoint subdivision, ``(V,)``.

    Plain subdivision keeps the vertices of the coarser level and appends the midpoints of the edges 01, 12,
    20 of all faces in order of first appearance; a face (0, 1, 2) is replaced by (0, 01, 20), (1, 12, 01),
    (01, 12, 20), (12, 2, 20). The icosahedron itself is ordered north pole, upper ring, lower ring, south
    pole.

    Examples:
        >>> subdivision_order(0)
        tensor([ 0,  1,  6,  2,  7,  3,  8,  4,  9,  5, 10, 11])
    """
    check_level(level)
    chart, corners = _icosahedron_faces_as_places()
    order = torch.tensor([0, 1, 6, 2, 7, 3, 8, 4, 9, 5, 10, 11])
    for fine in range(1, level + 1):
        ends = 2 * corners
        middles = (ends + ends.roll(-1, 1)) // 2
        ids = vertex_at(chart[:, None], middles[..., 0], middles[..., 1], fine).flatten()
        count = num_icosphere_vertices(fine)
        position = torch.arange(len(ids))
        first = torch.full((count,), -1).scatter_reduce(0, ids, position, "amin", include_self=False)
        coarse = coarse_vertex_ids(fine)
        finer_order = torch.empty(count, dtype=torch.long)
        finer_order[coarse] = order
        middle_ids = torch.argsort(first)[len(coarse) :]  # the vertices that are no midpoint have first == -1
        finer_order[middle_ids] = torch.arange(len(coarse), count)
        order = finer_order
        corner_0, corner_1, corner_2 = ends.unbind(1)
        middle_01, middle_12, middle_20 = middles.unbind(1)
        children = (
            *(corner_0, middle_01, middle_20),
            *(corner_1, middle_12, middle_01),
            *(middle_01, middle_12, middle_20),
            *(middle_12, corner_2, middle_20),
        )
        corners = torch.stack(children, 1).view(-1, 3, 2)
        chart = chart.repeat_interleave(4)
    return order.to(device)


def to_subdivision_order(values: Shaped[Tensor, "*batch V"]) -> Shaped[Tensor, "*batch V"]:
    """Return values on an icosphere ``(*, V)`` in the order of plain midpoint subdivision.

    Examples:
        >>> to_subdivision_order(torch.arange(12))
        tensor([ 0,  1,  3,  5,  7,  9,  2,  4,  6,  8, 10, 11])
    """
    order = subdivision_order(level_from_num_vertices(values.shape[-1]), values.device)
    return values.index_select(-1, order.argsort())


def from_subdivision_order(values: Shaped[Tensor, "*batch V"]) -> Shaped[Tensor, "*batch V"]:
    """Return values ``(*, V)`` that stand in the order of plain midpoint subdivision in the order of ``Icosphere``.

    Examples:
        >>> from_subdivision_order(to_subdivision_order(torch.arange(42))).equal(torch.arange(42))
        True
    """
    order = subdivision_order(level_from_num_vertices(values.shape[-1]), values.device)
    return values.index_select(-1, order)


def _icosahedron_faces_as_places() -> tuple[Tensor, Tensor]:
    """Return chart ``(20,)`` and the (row, column) of the corners ``(20, 3, 2)`` of the icosahedron's faces.

    The faces come as plain subdivision has them: around the north pole, the belt between the rings, around
    the south pole.
    """
    north, upper_west, lower_west = (0, 0), (1, 0), (2, 0)
    upper_east, lower_east, south = (0, 1), (1, 1), (2, 1)
    around_north = [(k, (north, upper_east, upper_west)) for k in range(5)]
    belt = [
        (k, face)
        for k in range(5)
        for face in ((upper_west, lower_east, lower_west), (upper_west, upper_east, lower_east))
    ]
    around_south = [(k, (lower_west, lower_east, south)) for k in range(5)]
    charts, corners = zip(*(around_north + belt + around_south), strict=True)
    return torch.tensor(charts), torch.tensor(corners)
