# SPDX-License-Identifier: Apache-2.0
"""Crowns by slices: charts continued by what lies across their borders, and rectangles made of them.

Whole edges are copied at a time where ``places`` looks up every vertex: same values, and a fraction of the time on a
CPU. With ``n = 2**level`` a chart owns ``2n`` rows and ``n`` columns of vertices. One more row in the north and one
more column in the east make it a ``col`` rectangle; all of these vertices are owned by the next chart, or are poles::

    row 0           north pole, then column 0 of the next chart, upper half
    last column     column 0 of the next chart, lower half, then its last row, then the south pole

A ``row`` rectangle is the northern half of one of these next to the southern half of the following one.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Num
from torch import Tensor

from sphericalvision.crown import hexagons
from sphericalvision.crown.fast.cpp import operators_in_use
from sphericalvision.crown.places import own_charts
from sphericalvision.icosphere import level_from_num_vertices


class _Unfold(torch.autograd.Function):
    """Copy each vertex of ``(B, C, [N,] V)`` to all its places, col and row; the adjoint is ``_Fold``."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, channels_fastest: bool) -> tuple[Tensor, Tensor]:
        return _unfold(values, channels_fastest)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return _Fold.apply(*gradients, None), None


class _Fold(torch.autograd.Function):
    """Sum each vertex over its places, or take their mean if their ``weight (V,)`` is given; adjoint of ``_Unfold``."""

    @staticmethod
    def forward(ctx: Any, col: Tensor, row: Tensor, weight: Tensor | None) -> Tensor:
        ctx.channels_fastest = col.stride(2) == 1
        ctx.save_for_backward(weight)
        total = _fold(col, row)
        return total if weight is None else total.mul_(weight)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        (weight,) = ctx.saved_tensors
        shared = gradient if weight is None else gradient * weight
        return *_Unfold.apply(shared, ctx.channels_fastest), None


def unfold(values: Num[Tensor, "B C *N V"]) -> tuple[Tensor, Tensor]:
    """Return col and row rectangles of values; channels are fastest in memory where that pays.

    It does for operators in C++ and for convolutions of torch, but not for the gradients of torch's normalisations.
    """
    col, row = _Unfold.apply(values, not torch.is_grad_enabled() or operators_in_use())
    return col, row


def fold(
    col: Float[Tensor, "B 5 C *N long short"], row: Float[Tensor, "B 5 C *N short long"]
) -> Float[Tensor, "B C *N V"]:
    """Return the mean of each vertex over all its places."""
    n, one = col.shape[-1] - 1, col.new_ones(1)
    number = _fold(one.expand(1, 5, 1, 2 * n + 1, n + 1), one.expand(1, 5, 1, n + 1, 2 * n + 1)).view(-1)
    return _Fold.apply(col, row, number.reciprocal())


def _empty_as(like: Tensor, shape: tuple[int, ...], channel_dim: int) -> Float[Tensor, " ..."]:
    """Return an uninitialised tensor, its channels fastest in memory if those of the rectangles ``like`` are."""
    if like.stride(2) != 1 or like.shape[2] == 1:
        return like.new_empty(shape)
    return _channels_fastest(like, shape, channel_dim)


def _channels_fastest(like: Tensor, shape: tuple[int, ...], channel_dim: int) -> Tensor:
    others = shape[:channel_dim] + shape[channel_dim + 1 :]
    return like.new_empty((*others, shape[channel_dim])).movedim(-1, channel_dim)


def _fill_north_and_east(
    rectangles: Num[Tensor, "B 5 C *N long short"], values: Num[Tensor, "B C *N V"]
) -> None:
    """Write values into rectangles ``(B, 5, C, [N,] 2n + 1, n + 1)``: charts and their northern and eastern borders."""
    n = rectangles.shape[-1] - 1
    charts = own_charts(values, n)
    west, south = charts[..., 0].roll(-1, 1), charts[..., -1, :].roll(-1, 1)  # edges of the next chart
    rectangles[..., 1:, :-1] = charts
    rectangles[..., 0, 0] = values[:, None, ..., 0]
    rectangles[..., 0, 1:] = west[..., :n]
    rectangles[..., 1 : n + 1, n] = west[..., n:]
    rectangles[..., n + 1 : -1, n] = south[..., 1:]
    rectangles[..., -1, n] = values[:, None, ..., -1]


def _fold_north_and_east(rectangles: Float[Tensor, "B 5 C *N long short"]) -> Float[Tensor, "B C *N V"]:
    """Sum rectangles into values: the adjoint of ``_fill_north_and_east``, line by line."""
    batch, _, *channels, _, columns = rectangles.shape
    n = columns - 1
    values = _empty_as(rectangles, (batch, *channels, 2 + 10 * n * n), 1)
    values[..., 0] = rectangles[..., 0, 0].sum(1)
    values[..., -1] = rectangles[..., -1, n].sum(1)
    charts = own_charts(values, n)
    charts.copy_(rectangles[..., 1:, :-1])
    charts[..., :n, 0] += rectangles[..., 0, 1:].roll(1, 1)
    charts[..., n:, 0] += rectangles[..., 1 : n + 1, n].roll(1, 1)
    charts[..., -1, 1:] += rectangles[..., n + 1 : -1, n].roll(1, 1)
    return values


def _unfold(values: Tensor, channels_fastest: bool) -> tuple[Tensor, Tensor]:
    batch, *channels, vertices = values.shape
    n = 2 ** level_from_num_vertices(vertices)
    new = _channels_fastest if channels_fastest else lambda like, shape, _: like.new_empty(shape)
    col = new(values, (batch, 5, *channels, 2 * n + 1, n + 1), 2)
    row = new(values, (batch, 5, *channels, n + 1, 2 * n + 1), 2)
    _fill_north_and_east(col, values)
    # The northern half of each chart, then the southern half of the next one, without the column that both have.
    row[..., : n + 1] = col[..., : n + 1, :]
    row[:, :4, ..., n + 1 :] = col[:, 1:, ..., n:, 1:]
    row[:, 4, ..., n + 1 :] = col[:, 0, ..., n:, 1:]
    return col, row


def _fold(col: Tensor, row: Tensor) -> Tensor:
    n = col.shape[-1] - 1
    total = _empty_as(col, tuple(col.shape), 2).copy_(col)
    total[..., : n + 1, :] += row[..., : n + 1]
    total[:, 1:, ..., n:, 1:] += row[:, :4, ..., n + 1 :]
    total[:, 0, ..., n:, 1:] += row[:, 4, ..., n + 1 :]
    return _fold_north_and_east(total)


def convolve_hexagons(values: Tensor, *args: Any) -> Tensor:
    """Convolve values or volumes as ``hexagons.hexagons`` does, with channels fastest in memory."""
    return hexagons.hexagons(values.movedim(1, -1).contiguous().movedim(-1, 1), *args)
