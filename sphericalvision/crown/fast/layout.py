# SPDX-License-Identifier: Apache-2.0
"""Crowns from values and back by slices, which copy whole edges at a time where the reference looks up every place.

Channels become the fastest dimension in memory, the layout that convolutions on a CPU are quickest with.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.crown.places import own_charts
from sphericalvision.icosphere import level_from_num_vertices

__all__ = ["Fold", "Unfold", "places_per_vertex"]


class Unfold(torch.autograd.Function):
    """Copy each vertex of ``(B, C, [N,] V)`` to all its places, col and row; the adjoint is ``Fold``."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> tuple[Tensor, Tensor]:
        return _unfold(values)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        return Fold.apply(*gradients)


class Fold(torch.autograd.Function):
    """Sum each vertex over all its places; the adjoint is ``Unfold``."""

    @staticmethod
    def forward(ctx: Any, col: Tensor, row: Tensor) -> Tensor:
        return _fold(col, row)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        return Unfold.apply(*gradients)


def places_per_vertex(n: int, like: Float[Tensor, " ..."]) -> Float[Tensor, " V"]:
    """Number of places ``(V,)`` in the crown of level ``log2(n)`` that each vertex stands in."""
    ones = like.new_ones(1)
    return _fold(ones.expand(1, 5, 1, 2 * n + 1, n + 1), ones.expand(1, 5, 1, n + 1, 2 * n + 1)).view(-1)


def _empty_channels_last(like: Tensor, channel_dim: int, shape: tuple[int, ...]) -> Tensor:
    """Return an uninitialised tensor of this shape whose channels are next to each other in memory."""
    channels = shape[channel_dim]
    return like.new_empty((*shape[:channel_dim], *shape[channel_dim + 1 :], channels)).movedim(
        -1, channel_dim
    )


def _unfold(values: Tensor) -> tuple[Tensor, Tensor]:
    batch, *channels, vertices = values.shape
    n = 2 ** level_from_num_vertices(vertices)
    charts = own_charts(values, n)
    col = _empty_channels_last(values, 2, (batch, 5, *channels, 2 * n + 1, n + 1))
    row = _empty_channels_last(values, 2, (batch, 5, *channels, n + 1, 2 * n + 1))

    west, south = charts[..., 0].roll(-1, 1), charts[..., -1, :].roll(-1, 1)  # edges of the next chart
    col[..., 1:, :-1] = charts
    col[..., 0, 0] = values[:, None, ..., 0]
    col[..., 0, 1:] = west[..., :n]
    col[..., 1 : n + 1, n] = west[..., n:]
    col[..., n + 1 : -1, n] = south[..., 1:]
    col[..., -1, n] = values[:, None, ..., -1]

    row[..., : n + 1] = col[..., : n + 1, :]
    row[:, :4, ..., n + 1 :] = col[:, 1:, ..., n:, 1:]
    row[:, 4, ..., n + 1 :] = col[:, 0, ..., n:, 1:]
    return col, row


def _fold(col: Tensor, row: Tensor) -> Tensor:
    batch, _, *channels, _, columns = col.shape
    n = columns - 1
    total = _empty_channels_last(col, 2, tuple(col.shape)).copy_(col)
    total[..., : n + 1, :] += row[..., : n + 1]
    total[:, 1:, ..., n:, 1:] += row[:, :4, ..., n + 1 :]
    total[:, 0, ..., n:, 1:] += row[:, 4, ..., n + 1 :]

    values = _empty_channels_last(col, 1, (batch, *channels, 2 + 10 * n * n))
    values[..., 0] = total[..., 0, 0].sum(1)
    values[..., -1] = total[..., -1, n].sum(1)
    charts = own_charts(values, n)
    charts.copy_(total[..., 1:, :-1])
    charts[..., :n, 0] += total[..., 0, 1:].roll(1, 1)
    charts[..., n:, 0] += total[..., 1 : n + 1, n].roll(1, 1)
    charts[..., -1, 1:] += total[..., n + 1 : -1, n].roll(1, 1)
    return values
