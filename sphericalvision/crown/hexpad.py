# SPDX-License-Identifier: Apache-2.0
"""Charts of an icosphere continued by their true neighbours, and the rings of its twelve special vertices.

With ``n = 2**level``, a chart owns ``2n`` rows and ``n`` columns of vertices. One more row and column on every side
hold what lies across the border. In the north and in the east that is what a ``col`` rectangle has there, too
(``unfolding``); in the west and in the south it is slices of the chart before::

    west column     its first row, then its last column, upper half and one more
    row 2n + 1      its last column, lower half

Along the edges of the polar faces this turns the neighbour by a sixth of a turn, as the sphere does. The twelve
vertices of the icosahedron have five neighbours, so they are gathered apart, as rings.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from sphericalvision.crown.places import check_values, own_charts
from sphericalvision.crown.unfolding import empty_as, fill_north_and_east, fold_north_and_east
from sphericalvision.icosphere import level_from_num_vertices
from sphericalvision.tables import constant_table

__all__ = ["fill_charts", "hex_pad", "ring_ids", "ring_values", "vertices_of_charts"]


def ring_ids(level: int) -> list[list[int]]:
    """Return the five neighbours of the twelve vertices of valence five and these vertices themselves, ``(12, 6)``.

    Vertices come in the order of their ids: north pole, A(k) and B(k) of chart k = 0 to 4, south pole. Neighbours
    go round counter-clockwise as panoramas are seen, from inside, towards

    * A(0) to A(4) at the north pole,
    * A(k-1), B(k), B(k+1), A(k+1) and the north pole at A(k),
    * the south pole, B(k+1), A(k), A(k-1) and B(k-1) at B(k),
    * B(1), B(0), B(4), B(3), B(2) at the south pole.

    Examples:
        >>> ring_ids(0)[:2]
        [[1, 3, 5, 7, 9, 0], [9, 2, 4, 3, 0, 1]]
    """
    n = 2**level
    last = 1 + 10 * n * n

    def own(chart: int, row: int, column: int) -> int:
        return 1 + ((chart % 5) * 2 * n + row - 1) * n + column

    def east(chart: int, row: int) -> int:
        """Place in column 1, which at level 0 is the border with the next chart."""
        if n > 1:
            return own(chart, row, 1) if row else own(chart + 1, 1, 0)
        return {0: own(chart + 1, 1, 0), 1: own(chart + 1, 2, 0), 2: last}[row]

    rings = [[own(k, 1, 0) for k in range(5)] + [0]]
    for k in range(5):
        rings.append(
            [
                own(k - 1, 1, n - 1),
                own(k, n + 1, 0),
                east(k, n),
                east(k, n - 1),
                own(k, n - 1, 0) if n > 1 else 0,
                own(k, n, 0),
            ]
        )
        rings.append(
            [
                east(k, 2 * n),
                east(k, 2 * n - 1),
                own(k, 2 * n - 1, 0),
                own(k - 1, n, n - 1),
                own(k - 1, n + 1, n - 1),
                own(k, 2 * n, 0),
            ]
        )
    rings.append([own(k, 2 * n, n - 1) for k in (1, 0, 4, 3, 2)] + [last])
    return rings


def hex_pad(
    values: Float[Tensor, "B C *N V"],
) -> tuple[Float[Tensor, "B 5 C *N rows columns"], Float[Tensor, "B C *N 12 6"]]:
    """Return the charts of values with their true neighbours around, and the rings of the special vertices.

    Args:
        values: ``(B, C, V)``, or ``(B, C, N, V)`` with N hypotheses.

    Returns:
        charts ``(B, 5, C, [N,] 2n + 2, n + 2)``, zero in the north-west and south-east corner, which are no
        neighbours of any vertex; and ``(B, C, [N,] 12, 6)``, five neighbours and the vertex itself, see ``ring_ids``.

    Raises:
        ShapeError: if the shape is another one or V is not the number of vertices of an icosphere.

    Examples:
        >>> charts, rings = hex_pad(torch.arange(12.0).view(1, 1, 12))
        >>> charts[0, 1, 0]
        tensor([[ 0.,  0.,  5.],
                [ 1.,  3.,  6.],
                [ 1.,  4., 11.],
                [ 2.,  2.,  0.]])
    """
    check_values(values)
    return _Pad.apply(values)


def ring_values(values: Float[Tensor, "B C *N V"]) -> Float[Tensor, "B C *N 12 6"]:
    """Return the rings of the special vertices alone, as ``hex_pad`` does.

    Examples:
        >>> ring_values(torch.arange(12.0).view(1, 1, 12))[0, 0, 0]
        tensor([1., 3., 5., 7., 9., 0.])
    """
    ids = _ring_table(level_from_num_vertices(values.shape[-1]), values.device)
    return values.index_select(-1, ids).unflatten(-1, (12, 6))


@lru_cache(maxsize=16)
@torch.inference_mode(False)  # kept for training, too
def vertices_of_charts(level: int) -> Int32[Tensor, "5 rows columns"]:
    """Return which vertex is where in the charts of ``hex_pad``, ``(5, 2n + 2, n + 2)``, on the CPU.

    The corners that are nobody's neighbours have the vertex beside them.

    Examples:
        >>> vertices_of_charts(0)[1]
        tensor([[ 0,  0,  5],
                [ 1,  3,  6],
                [ 1,  4, 11],
                [ 2,  2,  2]], dtype=torch.int32)
    """
    vertices = torch.arange(10 * 4**level + 2, dtype=torch.float64, device="cpu").view(1, 1, -1)
    places = _pad(vertices)[0][0, :, 0].int()
    places[:, 0, 0], places[:, -1, -1] = places[:, 0, 1], places[:, -1, -2]
    return places


def fill_charts(
    charts: Float[Tensor, "B 5 C *N rows columns"], special: Float[Tensor, "B C *N 12"]
) -> Float[Tensor, "B C *N V"]:
    """Return values ``(B, C, [N,] V)`` from what charts own and the twelve special vertices.

    Args:
        charts: ``(B, 5, C, [N,] 2n, n)``.
        special: ``(B, C, [N,] 12)``; these replace what the charts say.

    Examples:
        >>> fill_charts(torch.zeros(1, 5, 1, 4, 2), torch.ones(1, 1, 12)).sum()
        tensor(12.)
    """
    return _Fill.apply(charts, special)


class _Pad(torch.autograd.Function):
    """Copy values to charts and rings; the adjoint is ``_Unpad``."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> tuple[Tensor, Tensor]:
        return _pad(values)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        return _Unpad.apply(*gradients)


class _Unpad(torch.autograd.Function):
    """Sum charts and rings into values; the adjoint is ``_Pad``."""

    @staticmethod
    def forward(ctx: Any, padded: Tensor, rings: Tensor) -> Tensor:
        return _unpad(padded, rings)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        return _Pad.apply(*gradients)


class _Fill(torch.autograd.Function):
    """Copy charts and special vertices to values; the adjoint is ``_Take``."""

    @staticmethod
    def forward(ctx: Any, charts: Tensor, special: Tensor) -> Tensor:
        return _fill(charts, special)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        return _Take.apply(*gradients)


class _Take(torch.autograd.Function):
    """Copy values to charts without, and to a tensor with, the special vertices; the adjoint is ``_Fill``."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> tuple[Tensor, Tensor]:
        n = 2 ** level_from_num_vertices(values.shape[-1])
        charts = own_charts(values, n)
        # A and B of a chart are the last places of both halves of its west edge: rows n - 1 and 2n - 1 of its own.
        inner = charts[..., n - 1 :: n, 0].movedim(1, -2).flatten(-2)
        special = torch.cat((values[..., :1], inner, values[..., -1:]), -1)
        taken = empty_as(values, 1, tuple(charts.shape), 2).copy_(charts)
        taken[..., n - 1 :: n, 0] = 0
        return taken, special

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        return _Fill.apply(*gradients)


def _pad(values: Tensor) -> tuple[Tensor, Tensor]:
    batch, *channels, vertices = values.shape
    level = level_from_num_vertices(vertices)
    n = 2**level
    padded = empty_as(values, 1, (batch, 5, *channels, 2 * n + 2, n + 2), 2)
    fill_north_and_east(padded[..., :-1, 1:], values)
    # These two corners of the lattice are nobody's neighbours.
    padded[..., 0, 0] = 0
    padded[..., -1, -1] = 0
    charts = own_charts(values, n)
    # Rolled by one along the charts: each gets what the chart before it has. Its first row runs along our northern west
    # edge, its east edge along our southern west edge and, around the corner, along our last row.
    east = charts[..., -1].roll(1, 1)
    padded[..., 1 : n + 1, 0] = charts[..., 0, :].roll(1, 1)
    padded[..., n + 1 :, 0] = east[..., : n + 1]
    padded[..., -1, 1:-1] = east[..., n:]

    return padded, ring_values(values)


def _unpad(padded: Tensor, rings: Tensor) -> Tensor:
    n = padded.shape[-1] - 2
    values = fold_north_and_east(padded[..., :-1, 1:])
    charts = own_charts(values, n)
    # As in `_pad`, the other way about: each chart gets back what it gave to the one after it.
    charts[..., 0, :] += padded[..., 1 : n + 1, 0].roll(-1, 1)
    charts[..., : n + 1, -1] += padded[..., n + 1 :, 0].roll(-1, 1)
    charts[..., n:, -1] += padded[..., -1, 1:-1].roll(-1, 1)
    ids = _ring_table(n.bit_length() - 1, padded.device)
    return values.index_add_(-1, ids, rings.flatten(-2))


@constant_table
def _ring_table(level: int, device: torch.device) -> Tensor:
    """``ring_ids`` in one row."""
    return torch.tensor(ring_ids(level), device=device).flatten()


def _fill(charts: Tensor, special: Tensor) -> Tensor:
    batch, _, *channels, _, n = charts.shape
    values = empty_as(charts, 2, (batch, *channels, 2 + 10 * n * n), 1)
    own = own_charts(values, n)
    own.copy_(charts)
    own[..., n - 1 :: n, 0] = special[..., 1:-1].unflatten(-1, (5, 2)).movedim(-2, 1)
    values[..., 0], values[..., -1] = special[..., 0], special[..., -1]
    return values
