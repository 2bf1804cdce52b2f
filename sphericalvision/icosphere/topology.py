# SPDX-License-Identifier: Apache-2.0
"""Which vertex stands where: the charts of an icosphere and its faces.

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
from jaxtyping import Int
from torch import Tensor

from sphericalvision.core import ArgumentError, ShapeError, check_type
from sphericalvision.tables import constant_table, copied

MAX_LEVEL = 10
"""The finest icosphere: ten million vertices, three arc minutes apart. One level more takes four times the memory."""


def check_level(level: int, least: int = 0) -> int:
    """Return ``level`` or raise ``ArgumentError`` unless it is an integer from ``least``, 0 or 1, to ``MAX_LEVEL``.

    Examples:
        >>> check_level(7)
        7
    """
    if isinstance(level, bool) or not isinstance(level, int) or not least <= level <= MAX_LEVEL:
        first = "1, as the icosahedron has no coarser level," if least else "0 (icosahedron)"
        raise ArgumentError(
            f"level: expected an integer from {first} to {MAX_LEVEL} (ten million vertices), got {level!r}"
        )
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
    check_type("number of vertices", num_vertices, int)
    level = max((max(int(num_vertices), 2) - 2) // 10, 1).bit_length() // 2
    if level > MAX_LEVEL or num_icosphere_vertices(level) != num_vertices:
        raise ShapeError(
            f"number of vertices: expected 2 + 10 * 4**level (12, 42, 162, 642, 2562, ..., level {MAX_LEVEL} at most), "
            f"got {num_vertices}; values on an icosphere keep their vertices in the last dimension"
        )
    return level


def vertex_at(
    chart: Int[Tensor, " ..."], row: Int[Tensor, " ..."], column: Int[Tensor, " ..."], level: int
) -> Int[Tensor, " ..."]:
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


def chart_vertex_ids(level: int, device: torch.device | str | None = None) -> Int[Tensor, "5 rows columns"]:
    """Return the vertex at every place of the five charts, borders included, ``(5, 2n + 1, n + 1)``.

    Examples:
        >>> chart_vertex_ids(0)[0].tolist()
        [[0, 3], [1, 4], [2, 11]]
    """
    n = 2 ** check_level(level)
    chart = torch.arange(5, device=device)[:, None, None]
    row = torch.arange(2 * n + 1, device=device)[:, None]
    return vertex_at(chart, row, torch.arange(n + 1, device=device), level)


@copied
@constant_table
def icosphere_faces(level: int, device: torch.device | str | None = None) -> Int[Tensor, "F 3"]:
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


@copied
@constant_table
def coarse_vertex_ids(level: int, device: torch.device | str | None = None) -> Int[Tensor, " V"]:
    """Return, for each vertex of the next coarser icosphere, its id in the icosphere of this level.

    Examples:
        >>> coarse_vertex_ids(1)
        tensor([ 0,  3,  7, 11, 15, 19, 23, 27, 31, 35, 39, 41])
    """
    n = 2 ** check_level(level, 1)
    ids = torch.arange(num_icosphere_vertices(level), device=device)
    charts = ids[1:-1].view(5, 2 * n, n)[:, 1::2, ::2]
    return torch.cat((ids[:1], charts.flatten(), ids[-1:]))
