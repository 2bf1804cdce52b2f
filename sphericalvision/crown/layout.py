# SPDX-License-Identifier: Apache-2.0
"""The crown: values on an icosphere laid out as ten rectangles, five each way, so that planar convolutions
apply.

``col`` rectangle k is chart k of the icosphere with all its borders. ``row`` rectangle k lies across: its
western half is the northern half of chart k, its eastern half the southern half of chart k + 1. Vertices on
the border of one kind of rectangle are inside the other, which is why both are kept and averaged now and
then (``exchange``). Everything is done by slices; channels are the fastest dimension in memory, the layout
that convolutions on a CPU are quickest with.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from sphericalvision.core import ShapeError
from sphericalvision.icosphere import (
    chart_vertex_ids,
    level_from_num_vertices,
    num_icosphere_vertices,
    vertex_at,
)

__all__ = ["Crown", "crown_map", "crown_relu", "exchange", "from_crown", "to_crown"]


class Crown(NamedTuple):
    """Five rectangles each way; ``n = 2**level``, and volumes have N hypotheses.

    Attributes:
        col: ``(B, 5, C, 2n + 1, n + 1)`` or ``(B, 5, C, N, 2n + 1, n + 1)``.
        row: ``(B, 5, C, n + 1, 2n + 1)`` or ``(B, 5, C, N, n + 1, 2n + 1)``.

    ``crown + other`` adds the rectangles.

    Examples:
        >>> crown = to_crown(torch.zeros(1, 8, 162))
        >>> crown.col.shape, crown.row.shape
        (torch.Size([1, 5, 8, 9, 5]), torch.Size([1, 5, 8, 5, 9]))
        >>> crown.level
        2
    """

    col: Tensor
    row: Tensor

    @property
    def level(self) -> int:
        """Level of the icosphere whose vertices are laid out."""
        return (self.col.shape[-1] - 1).bit_length() - 1

    def __add__(self, other: Crown) -> Crown:  # type: ignore[override]
        return Crown(self.col + other.col, self.row + other.row)


def check_crown(crown: Crown, spatial_dims: int | None = None) -> None:
    """Raise ``ShapeError`` unless ``crown`` has ten rectangles that match, of ``spatial_dims`` 2 or 3 if given."""
    col, row = crown
    n = col.shape[-1] - 1 if col.ndim >= 5 else 0
    sizes_match = n > 0 and n & (n - 1) == 0 and tuple(col.shape[-2:]) == (2 * n + 1, n + 1)
    matches = sizes_match and col.ndim in (5, 6) and (*col.shape[:-2], n + 1, 2 * n + 1) == tuple(row.shape)
    if not matches or col.shape[1] != 5 or (spatial_dims is not None and col.ndim != spatial_dims + 3):
        hypotheses = {None: "[N,] ", 2: "", 3: "N, "}[spatial_dims]
        raise ShapeError(
            f"crown: expected col (B, 5, C, {hypotheses}2n + 1, n + 1) and "
            f"row (B, 5, C, {hypotheses}n + 1, 2n + 1) with n = 2**level, "
            f"got col {tuple(col.shape)} and row {tuple(row.shape)}; make it with to_crown"
        )


def to_crown(values: Tensor) -> Crown:
    """Lay values on an icosphere out as a crown; its level follows from the number of vertices.

    Args:
        values: ``(B, C, V)``, or ``(B, C, N, V)`` with N hypotheses.

    Raises:
        ShapeError: if the shape is another one or V is not the number of vertices of an icosphere.

    References:
        Komatsu et al. (2020), "360° depth estimation from multiple fisheye images with origami crown
        representation of icosahedron", section III.

    Examples:
        >>> to_crown(torch.arange(12.0).view(1, 1, 12)).col[0, 0, 0]
        tensor([[ 0.,  3.],
                [ 1.,  4.],
                [ 2., 11.]])
    """
    if values.ndim not in (3, 4):
        raise ShapeError(f"values: expected shape (B, C, V) or (B, C, N, V), got {tuple(values.shape)}")
    level_from_num_vertices(values.shape[-1])
    return Crown(*_Unfold.apply(values))


def from_crown(crown: Crown) -> Tensor:
    """Return values on the icosphere, ``(B, C, V)`` or ``(B, C, N, V)``: the mean over every place a vertex
    stands in.

    Raises:
        ShapeError: if the rectangles do not belong together.

    References:
        Komatsu et al. (2020), the inverse of the unfolding to the crown.

    Examples:
        >>> values = torch.rand(2, 3, 42)
        >>> torch.allclose(from_crown(to_crown(values)), values)
        True
    """
    check_crown(crown)
    return _Fold.apply(*crown) * places_per_vertex(crown.col.shape[-1] - 1, crown.col).reciprocal()


def places_per_vertex(n: int, like: Tensor) -> Tensor:
    """Number of places ``(V,)`` in the crown of level ``log2(n)`` that each vertex stands in."""
    ones = like.new_ones(1)
    return _fold(ones.expand(1, 5, 1, 2 * n + 1, n + 1), ones.expand(1, 5, 1, n + 1, 2 * n + 1)).view(-1)


def exchange(crown: Crown) -> Crown:
    """Give every place of a vertex the mean over all its places, so that values flow across borders.

    Examples:
        >>> crown = exchange(Crown(torch.ones(1, 5, 1, 3, 2), torch.zeros(1, 5, 1, 2, 3)))
        >>> crown.col.unique()
        tensor([0.5000])
    """
    return to_crown(from_crown(crown))


def crown_map(function: Callable[..., Tensor], *crowns: Crown) -> Crown:
    """Apply a function to the ``col`` tensors and to the ``row`` tensors of one or more crowns.

    Examples:
        >>> crown = to_crown(torch.ones(1, 1, 12))
        >>> crown_map(torch.add, crown, crown).col.unique()
        tensor([2.])
    """
    return Crown(function(*(crown.col for crown in crowns)), function(*(crown.row for crown in crowns)))


def crown_relu(crown: Crown) -> Crown:
    """Rectify a crown.

    Examples:
        >>> crown_relu(to_crown(-torch.ones(1, 1, 12))).row.max()
        tensor(0.)
    """
    return crown_map(torch.relu, crown)


class _Unfold(torch.autograd.Function):
    """Copy each vertex to all its places; the adjoint is ``_Fold``."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> tuple[Tensor, Tensor]:
        return _unfold(values)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        return _Fold.apply(*gradients)


class _Fold(torch.autograd.Function):
    """Sum each vertex over all its places; the adjoint is ``_Unfold``."""

    @staticmethod
    def forward(ctx: Any, col: Tensor, row: Tensor) -> Tensor:
        return _fold(col, row)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        return _Unfold.apply(*gradients)


def _charts(values: Tensor, n: int) -> Tensor:
    """View ``(B, C, [N,] V)`` without the poles as ``(B, 5, C, [N,] 2n, n)``."""
    return values[..., 1:-1].unflatten(-1, (5, 2 * n, n)).movedim(-3, 1)


def _empty_channels_last(like: Tensor, channel_dim: int, shape: tuple[int, ...]) -> Tensor:
    """Return an uninitialised tensor of this shape whose channels are next to each other in memory."""
    channels = shape[channel_dim]
    return like.new_empty((*shape[:channel_dim], *shape[channel_dim + 1 :], channels)).movedim(
        -1, channel_dim
    )


def _place_ids(level: int, device: torch.device) -> Tensor:
    """Vertices at the places of five col and then five row rectangles, ``(10, (2n + 1) * (n + 1))``."""
    n = 2**level
    chart = torch.arange(5, device=device)[:, None, None]
    row, column = torch.arange(n + 1, device=device)[:, None], torch.arange(2 * n + 1, device=device)
    west = vertex_at(chart, row, column.clamp(max=n), level)
    east = vertex_at((chart + 1) % 5, row + n, (column - n).clamp(min=0), level)
    across = torch.where(column <= n, west, east)
    return torch.cat((chart_vertex_ids(level, device).flatten(1), across.flatten(1)))


def _unfold_by_index(values: Tensor) -> tuple[Tensor, Tensor]:
    """``_unfold`` as one look-up, for compilers and exporters, which are slow at many slices."""
    level = level_from_num_vertices(values.shape[-1])
    n = 2**level
    places = values.index_select(-1, _place_ids(level, values.device).flatten()).unflatten(-1, (10, -1))
    col, row = places.movedim(-2, 1).split(5, 1)
    return col.unflatten(-1, (2 * n + 1, n + 1)), row.unflatten(-1, (n + 1, 2 * n + 1))


def _fold_by_index(col: Tensor, row: Tensor) -> Tensor:
    """``_fold`` as one sum by index."""
    level = (col.shape[-1] - 1).bit_length() - 1
    places = torch.cat((col.flatten(-2), row.flatten(-2)), 1).movedim(1, -2).flatten(-2)
    ids = _place_ids(level, col.device).flatten().expand(places.shape)
    values = places.new_zeros((*places.shape[:-1], num_icosphere_vertices(level)))
    return values.scatter_add(-1, ids, places)


def _unfold(values: Tensor) -> tuple[Tensor, Tensor]:
    if torch.compiler.is_compiling():
        return _unfold_by_index(values)
    batch, *channels, vertices = values.shape
    n = 2 ** level_from_num_vertices(vertices)
    charts = _charts(values, n)
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
    if torch.compiler.is_compiling():
        return _fold_by_index(col, row)
    batch, _, *channels, _, columns = col.shape
    n = columns - 1
    total = _empty_channels_last(col, 2, tuple(col.shape)).copy_(col)
    total[..., : n + 1, :] += row[..., : n + 1]
    total[:, 1:, ..., n:, 1:] += row[:, :4, ..., n + 1 :]
    total[:, 0, ..., n:, 1:] += row[:, 4, ..., n + 1 :]

    values = _empty_channels_last(col, 1, (batch, *channels, 2 + 10 * n * n))
    values[..., 0] = total[..., 0, 0].sum(1)
    values[..., -1] = total[..., -1, n].sum(1)
    charts = _charts(values, n)
    charts.copy_(total[..., 1:, :-1])
    charts[..., :n, 0] += total[..., 0, 1:].roll(1, 1)
    charts[..., n:, 0] += total[..., 1 : n + 1, n].roll(1, 1)
    charts[..., -1, 1:] += total[..., n + 1 : -1, n].roll(1, 1)
    return values
