# SPDX-License-Identifier: Apache-2.0
"""Charts of an icosphere continued by their true neighbours, and the rings of its twelve special vertices.

With ``n = 2**level``, a chart owns ``2n`` rows and ``n`` columns of vertices. One more row and column on every side
hold what lies across the border. In the north and in the east that is what a ``col`` rectangle has there, too; in the
west and in the south it is slices of the chart before::

    west column     its first row, then its last column, upper half and one more
    row 2n + 1      its last column, lower half

Along the edges of the polar faces this turns the neighbour by a sixth of a turn, as the sphere does. The twelve
vertices of the icosahedron have five neighbours, so they are gathered apart, as rings.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from sphericalvision.icosphere import level_from_num_vertices
from sphericalvision.icosphere.topology import chart_vertex_ids
from sphericalvision.shapes import check_shapes
from sphericalvision.tables import constant_table


@constant_table
def chart_vertices(level: int, device: torch.device) -> Int[Tensor, "5 rows columns"]:
    """Return the vertices of the charts of ``hex_pad``, ``(5, 2n + 2, n + 2)``.

    The two corners without neighbours repeat the vertex next to them.

    Examples:
        >>> chart_vertices(0, torch.device("cpu"))[1]
        tensor([[ 0,  0,  5],
                [ 1,  3,  6],
                [ 1,  4, 11],
                [ 2,  2,  2]])
    """
    n = 2**level
    before = torch.arange(1, 10 * n * n + 1, device=device).view(5, 2 * n, n).roll(1, 0)
    padded = before.new_empty(5, 2 * n + 2, n + 2)
    padded[:, :-1, 1:] = chart_vertex_ids(level, device)
    # The first row of the chart before runs along our northern west edge, its east edge along our southern west edge
    # and, around the corner, along our last row.
    padded[:, 1 : n + 1, 0] = before[:, 0]
    padded[:, n + 1 :, 0] = before[:, : n + 1, -1]
    padded[:, -1, 1:-1] = before[:, n:, -1]
    padded[:, 0, 0], padded[:, -1, -1] = padded[:, 0, 1], padded[:, -1, -2]
    return padded


@check_shapes
def hex_pad(
    values: Float[Tensor, "B C V"] | Float[Tensor, "B C N V"],
) -> Float[Tensor, "B 5 C *N rows columns"]:
    """Return the charts of values with their true neighbours around.

    Args:
        values: ``(B, C, V)``, or ``(B, C, N, V)`` with N hypotheses.

    Returns:
        ``(B, 5, C, [N,] 2n + 2, n + 2)``, channels the fastest in memory if those of the values are; zero in the
        north-west and south-east corner, which are no neighbours of any vertex.

    Examples:
        >>> hex_pad(torch.arange(12.0).view(1, 1, 12))[0, 1, 0]
        tensor([[ 0.,  0.,  5.],
                [ 1.,  3.,  6.],
                [ 1.,  4., 11.],
                [ 2.,  2.,  0.]])
    """
    vertices = chart_vertices(level_from_num_vertices(values.shape[-1]), values.device)
    # All channels of a vertex in a row, which are read at once; of all samples and hypotheses one below the other.
    rows = values.movedim(1, -1)
    *batch, size, channels = rows.shape
    rows = rows.reshape(math.prod(batch) * size, channels)
    first = torch.arange(0, len(rows), size, device=rows.device)
    charts = F.embedding(first[:, None] + vertices.flatten(), rows)
    charts = charts.view(*batch, *vertices.shape, channels).movedim((-4, -1), (1, 2))
    charts[..., 0, 0] = 0
    charts[..., -1, -1] = 0
    return charts if _is_fastest(values, 1) else charts.contiguous()


def ring_values(values: Float[Tensor, "B C *N V"]) -> Float[Tensor, "B C *N 12 6"]:
    """Return the rings of the twelve special vertices: five neighbours and the vertex itself, see ``ring_table``.

    Examples:
        >>> ring_values(torch.arange(12.0).view(1, 1, 12))[0, 0, 0]
        tensor([1., 3., 5., 7., 9., 0.])
    """
    ids = ring_table(level_from_num_vertices(values.shape[-1]), values.device)
    return values.index_select(-1, ids.flatten()).unflatten(-1, (12, 6))


@constant_table
def ring_table(level: int, device: torch.device) -> Int[Tensor, "12 6"]:
    """Return the five neighbours of the twelve vertices of valence five and these vertices themselves, ``(12, 6)``.

    Vertices come in the order of their ids: north pole, A(k) and B(k) of chart k = 0 to 4, south pole. Neighbours
    go round counter-clockwise as panoramas are seen, from inside, towards

    * A(0) to A(4) at the north pole,
    * A(k-1), B(k), B(k+1), A(k+1) and the north pole at A(k),
    * the south pole, B(k+1), A(k), A(k-1) and B(k-1) at B(k),
    * B(1), B(0), B(4), B(3), B(2) at the south pole.

    Examples:
        >>> ring_table(0, torch.device("cpu"))[:2].tolist()
        [[1, 3, 5, 7, 9, 0], [9, 2, 4, 3, 0, 1]]
    """
    n, charts = 2**level, chart_vertices(level, device)
    # Taps 0 to 5 and the centre around A and B, which a chart owns in its first column; the gap is left out.
    around = torch.tensor(((0, -1), (1, -1), (1, 0), (0, 1), (-1, 1), (-1, 0), (0, 0)), device=device)
    upper, lower = (charts[:, row + around[:, 0], 1 + around[:, 1]] for row in (n, 2 * n))
    belt = torch.stack((upper[:, [0, 2, 3, 4, 5, 6]], lower[:, [3, 4, 5, 0, 1, 6]]), 1).flatten(0, 1)
    north = torch.cat((charts[:, 1, 1], charts[0, 0, 1:2]))
    south = torch.cat((charts[[1, 0, 4, 3, 2], -2, -2], charts[0, -2, -1:]))
    return torch.cat((north[None], belt, south[None]))


def fill_charts(
    charts: Float[Tensor, "B 5 C *N rows columns"], special: Float[Tensor, "B C *N 12"]
) -> Float[Tensor, "B C *N V"]:
    """Return values ``(B, C, [N,] V)`` from what charts own and the twelve special vertices.

    Args:
        charts: ``(B, 5, C, [N,] 2n, n)``.
        special: ``(B, C, [N,] 12)``, in place of the values in the charts.

    Examples:
        >>> fill_charts(torch.zeros(1, 5, 1, 4, 2), torch.ones(1, 1, 12)).sum()
        tensor(12.)
    """
    centers = ring_table(charts.shape[-1].bit_length() - 1, charts.device)[:, 5]
    own = charts.movedim((1, 2), (-4, -1)).flatten(-4, -2)
    special = special.to(charts.dtype).movedim(1, -1)
    values = torch.cat((special[..., :1, :], own, special[..., -1:, :]), -2)
    values = values.index_copy_(-2, centers, special).movedim(-1, 1)
    return values if _is_fastest(charts, 2) else values.contiguous()


def _is_fastest(values: Tensor, dim: int) -> bool:
    """Whether a dimension is the fastest in memory: convolutions of torch round by the layout that they are given."""
    return values.stride(dim) == 1 and values.shape[dim] > 1
