# SPDX-License-Identifier: Apache-2.0
"""Which vertex stands where: the charts of an icosphere, its faces, neighbours and levels.

Cut the icosahedron along its seams from pole to pole and it falls into five *charts*. With ``n = 2**level``,
chart k is a rectangle of ``2n + 1`` rows and ``n + 1`` columns. Seen from inside, as a panorama is, its corners
are (N and S are the poles, A the upper and B the lower ring of five vertices)::

    row 0    N ──── A(k+1)      every cell is cut along its anti-diagonal,
    row n    A(k) ─ B(k+1)      from (row + 1, column) to (row, column + 1)
    row 2n   B(k) ─ S

Without its first row and last column a chart has ``2n * n`` vertices, and each vertex but the poles is in
exactly one of them. Hence the order of vertices: north pole, the five charts row by row, south pole.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sphericalvision.core import ArgumentError, ShapeError

__all__ = [
    "chart_vertex_ids",
    "coarse_vertex_ids",
    "icosphere_faces",
    "icosphere_neighbors",
    "level_from_num_vertices",
    "num_icosphere_vertices",
    "subdivision_order",
    "vertex_at",
]


def check_level(level: int) -> int:
    """Return ``level`` or raise ``ArgumentError`` unless it is an integer of 0 or more."""
    if isinstance(level, bool) or not isinstance(level, int) or level < 0:
        raise ArgumentError(f"level: expected an integer of 0 (icosahedron) or more, got {level!r}")
    return level


def num_icosphere_vertices(level: int) -> int:
    """Return the number of vertices of an icosphere, ``2 + 10 * 4**level``.

    Examples:
        >>> [num_icosphere_vertices(level) for level in range(4)]
        [12, 42, 162, 642]
    """
    return 2 + 10 * 4 ** check_level(level)


def level_from_num_vertices(num_vertices: int) -> int:
    """Return the level of the icosphere with this many vertices.

    Raises:
        ShapeError: if no icosphere has this number of vertices.

    Examples:
        >>> level_from_num_vertices(642)
        3
    """
    level = max((max(int(num_vertices), 2) - 2) // 10, 1).bit_length() // 2
    if num_icosphere_vertices(level) != num_vertices:
        raise ShapeError(
            f"number of vertices: expected 2 + 10 * 4**level (12, 42, 162, 642, 2562, ...), "
            f"got {num_vertices}; values on an icosphere keep their vertices in the last dimension"
        )
    return level


def vertex_at(chart: Tensor, row: Tensor, column: Tensor, level: int) -> Tensor:
    """Return the vertex at a place of a chart, borders included; shapes broadcast.

    Args:
        chart: number of the chart, 0 to 4.
        row: 0 (north) to ``2 * 2**level``.
        column: 0 (west) to ``2**level``.
        level: subdivision level of the icosphere.

    Examples:
        >>> zero = torch.tensor(0)
        >>> vertex_at(torch.arange(5), zero, zero, level=3)  # the north pole is a corner of all charts
        tensor([0, 0, 0, 0, 0])
    """
    n = 2**level
    north, east = row == 0, column == n
    # The north edge is the upper left edge of the next chart; the east edge is its lower left edge, then its
    # last row.
    own_row = torch.where(east, (row + n).clamp(max=2 * n), torch.where(north, column, row))
    own_column = torch.where(east, (row - n).clamp(min=0), torch.where(north, 0, column))
    own_chart = torch.where(north | east, (chart + 1) % 5, chart)
    ids = 1 + (own_chart * (2 * n) + own_row - 1) * n + own_column
    ids = torch.where(north & (column == 0), 0, ids)
    return torch.where(east & (row == 2 * n), num_icosphere_vertices(level) - 1, ids)


def chart_vertex_ids(level: int, device: torch.device | str | None = None) -> Tensor:
    """Return the vertex at every place of the five charts, borders included, ``(5, 2n + 1, n + 1)``.

    Examples:
        >>> chart_vertex_ids(0)[0].tolist()
        [[0, 3], [1, 4], [2, 11]]
    """
    n = 2 ** check_level(level)
    chart = torch.arange(5, device=device)[:, None, None]
    row = torch.arange(2 * n + 1, device=device)[:, None]
    return vertex_at(chart, row, torch.arange(n + 1, device=device), level)


def icosphere_faces(level: int, device: torch.device | str | None = None) -> Tensor:
    """Return the ``(20 * 4**level, 3)`` triangles, counter-clockwise seen from outside.

    Face ``2 * ((chart * 2n + row) * n + column) + half`` is half 0 (north-west) or 1 (south-east) of that
    cell.

    Examples:
        >>> icosphere_faces(0)[:2].tolist()
        [[0, 3, 1], [4, 1, 3]]
    """
    ids = chart_vertex_ids(level, device)
    north_west, north_east = ids[:, :-1, :-1], ids[:, :-1, 1:]
    south_west, south_east = ids[:, 1:, :-1], ids[:, 1:, 1:]
    upper = torch.stack((north_west, north_east, south_west), -1)
    lower = torch.stack((south_east, south_west, north_east), -1)
    return torch.stack((upper, lower), -2).reshape(-1, 3)


def icosphere_neighbors(level: int, device: torch.device | str | None = None) -> Tensor:
    """Return the neighbours of every vertex, counter-clockwise seen from outside, ``(V, 6)``.

    The twelve vertices of the icosahedron have five neighbours; their last entry is -1.

    Examples:
        >>> icosphere_neighbors(0)[0]  # the north pole
        tensor([ 1,  9,  7,  5,  3, -1])
    """
    faces = icosphere_faces(level, device)
    # Half-edge (v, a) of the triangle (v, a, b) is followed by (v, b), which belongs to the next triangle
    # around v.
    center = faces.flatten()
    leaving, arriving = faces.roll(-1, 1).flatten(), faces.roll(-2, 1).flatten()
    count = num_icosphere_vertices(level)
    key, order = torch.sort(center * count + leaving)
    following = torch.searchsorted(key, center[order] * count + arriving[order])
    first = torch.searchsorted(key, torch.arange(count, device=faces.device) * count)
    leaving, edge, around = leaving[order], first, []
    for _ in range(6):
        around.append(leaving[edge])
        edge = following[edge]
    neighbors = torch.stack(around, -1)
    closes_early = neighbors[:, 5] == neighbors[:, 0]
    neighbors[closes_early, 5] = -1
    return neighbors


def coarse_vertex_ids(level: int, device: torch.device | str | None = None) -> Tensor:
    """Return, for each vertex of the next coarser icosphere, its id in the icosphere of this level.

    Raises:
        ArgumentError: at level 0, which has no coarser one.

    Examples:
        >>> coarse_vertex_ids(1)
        tensor([ 0,  3,  7, 11, 15, 19, 23, 27, 31, 35, 39, 41])
    """
    if check_level(level) == 0:
        raise ArgumentError("level: expected 1 or more, got 0: the icosahedron has no coarser level")
    n = 2**level
    ids = torch.arange(num_icosphere_vertices(level), device=device)
    charts = ids[1:-1].view(5, 2 * n, n)[:, 1::2, ::2]
    return torch.cat((ids[:1], charts.flatten(), ids[-1:]))


def subdivision_order(level: int, device: torch.device | str | None = None) -> Tensor:
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
