# SPDX-License-Identifier: Apache-2.0
"""Crowns and hexagonal convolutions by few large lookups: see ``kernels.prefer_fused``."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, Num
from torch import Tensor

from sphericalvision.crown.hexpad import hex_pad
from sphericalvision.crown.places import level_of_rectangles, place_ids
from sphericalvision.crown.taps import COL_TAPS, neighbor_taps
from sphericalvision.geometry.means_by_id import MeansById, mean_by_id, means_by_id
from sphericalvision.icosphere import level_from_num_vertices, num_icosphere_vertices
from sphericalvision.icosphere.topology import coarse_vertex_ids
from sphericalvision.kernels import use_triton
from sphericalvision.tables import constant_table

__all__ = ["fold_by_lookups", "hex_conv_by_lookups", "unfold_by_lookups"]

Rings = tuple[tuple[int, ...], ...]


def unfold_by_lookups(values: Num[Tensor, "B C *N V"]) -> Num[Tensor, "B C *N places"]:
    """Look values up at the places of all rectangles, one after the other."""
    if torch.compiler.is_compiling() or torch._C._are_functorch_transforms_active():
        return values.index_select(-1, _places(level_from_num_vertices(values.shape[-1]), values.device).ids)
    return _Unfold.apply(values)  # type: ignore[no-any-return]


def fold_by_lookups(
    col: Float[Tensor, "B 5 C *N long short"], row: Float[Tensor, "B 5 C *N short long"]
) -> Float[Tensor, "B C *N V"]:
    """Return the mean of each vertex over all its places, as ``from_crown`` does."""
    places = torch.cat([rectangles.flatten(-2).movedim(1, -2) for rectangles in (col, row)], -2).flatten(-2)
    level = level_of_rectangles(col)
    if torch.compiler.is_compiling() or torch._C._are_functorch_transforms_active():
        return mean_by_id(places, _places(level, places.device).means)
    return _Fold.apply(places, level)  # type: ignore[no-any-return]


class _Places(NamedTuple):
    ids: Int[Tensor, " places"]
    means: MeansById
    counts: Float[Tensor, " V"]


@constant_table
def _places(level: int, device: torch.device) -> _Places:
    """Vertices at all places; where the places of each are; and their number."""
    ids, number = place_ids(level, device).flatten(), num_icosphere_vertices(level)
    return _Places(ids, means_by_id(ids, number), ids.bincount(minlength=number).float())


class _Unfold(torch.autograd.Function):
    """Values ``(*, V)`` at all places ``(*, P)``: the derivative is looked up as well, where torch would add up."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        ctx.level = level_from_num_vertices(values.shape[-1])
        return values.index_select(-1, _places(ctx.level, values.device).ids)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (gradient,) = gradients
        return _Fold.apply(gradient, ctx.level) * _places(ctx.level, gradient.device).counts.to(
            gradient.dtype
        )  # type: ignore[no-any-return]


class _Fold(torch.autograd.Function):
    """The mean ``(*, V)`` of what is at the places ``(*, P)`` of each vertex."""

    @staticmethod
    def forward(ctx: Any, places: Tensor, level: int) -> Tensor:
        return mean_by_id(places, _places(level, places.device).means)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        (gradient,) = gradients
        level = level_from_num_vertices(gradient.shape[-1])
        return _Unfold.apply(gradient / _places(level, gradient.device).counts.to(gradient.dtype)), None


class TapTables(NamedTuple):
    """What seven taps read at each vertex of the result.

    Attributes:
        taps: ``(V_out * 7,)`` vertices, V + s for the mean around the special vertex s.
        around: ``(60,)`` five neighbours of each of the twelve special vertices.
        reads: ``(V_out * 7 + 63,)`` the taps, with any vertex in place of a mean, then ``around``, then three more, so
            that there are nine times seven.
        gaps: ``(12,)`` where in ``reads`` the means belong.
    """

    taps: Int[Tensor, " V_out_times_7"]
    around: Int[Tensor, " 60"]
    reads: Int[Tensor, " reads"]
    gaps: Int[Tensor, " 12"]


def hex_conv_by_lookups(
    values: Float[Tensor, "B C_in V"],
    weight: Float[Tensor, "C_out C_in 7"],
    bias: Float[Tensor, " C_out"] | None,
    stride: int,
    rings: Rings,
    rectify: bool = False,
    residual: Float[Tensor, "B C_out V_out"] | None = None,
) -> Float[Tensor, "B C_out V_out"]:
    """Convolve along the charts, as ``hex_conv2d`` does: look the seven taps of every vertex up, then multiply.

    Args:
        values: ``(B, in, V)``.
        weight: ``(out, in, 7)``.
        bias: ``(out,)``.
        stride: 1 or 2.
        rings: taps of the five neighbours and of the gap at the north pole, A, B and the south pole.
        rectify: whether values pass a ReLU first.
        residual: is added to the result.
    """
    tables = _tap_tables(level_from_num_vertices(values.shape[-1]), stride, rings, values.device)
    given = [tensor for tensor in (values, weight, bias, residual) if tensor is not None]
    exact = all(tensor.dtype == torch.float32 for tensor in given)
    if use_triton(*given) and exact and not torch.is_autocast_enabled("cuda"):
        from sphericalvision.crown.hexconv_triton import hex_conv_kernel  # Triton is not everywhere

        return hex_conv_kernel(values, weight, bias, tables.around, tables.taps, rectify, residual)
    read = (values.relu() if rectify else values).index_select(-1, tables.reads)
    means = read[..., -63:-3].unflatten(-1, (12, 5)).mean(-1)
    read.index_copy_(-1, tables.gaps, means)
    # Seven values a vertex in a row: a convolution that goes on by seven needs no other order of the weights.
    result = F.conv1d(read, weight, bias, stride=7)[..., :-9]
    return result if residual is None else residual + result


@constant_table
def _tap_tables(level: int, stride: int, rings: Rings, device: torch.device) -> TapTables:
    number, n = num_icosphere_vertices(level), 2**level
    charts, special = hex_pad(torch.arange(number, dtype=torch.float64, device=device)[None, None])
    charts, special = charts[0, :, 0].long(), special[0, 0].long()
    places = neighbor_taps(COL_TAPS)
    own = torch.stack(
        [charts[:, place // 3 : place // 3 + 2 * n, place % 3 : place % 3 + n] for place in places], -1
    )
    order = torch.tensor([sum(COL_TAPS, ())[place] for place in places], device=device)
    taps = special.new_empty(number, 7)
    taps[1:-1, order] = own.view(-1, 7)
    pole_north, a, b, pole_south = rings
    for vertex, ring in enumerate((pole_north, *(a, b) * 5, pole_south)):
        *neighbors, center = special[vertex]
        taps[center, torch.tensor(ring, device=device)] = torch.stack(
            (*neighbors, center * 0 + number + vertex)
        )
        taps[center, 6] = center
    taps = (taps if stride == 1 else taps[coarse_vertex_ids(level, device)]).flatten()
    around = special[:, :5].flatten()
    is_gap = taps >= number
    gaps = is_gap.nonzero()[:, 0]
    reads = torch.cat((taps.masked_fill(is_gap, 0), around, around[:3]))
    return TapTables(taps, around, reads, gaps[taps[gaps].argsort()])
