# SPDX-License-Identifier: Apache-2.0
"""Crowns, their normalisation and hexagonal convolutions by few large operators, none of which waits for a value."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, Num
from torch import Tensor

from sphericalvision.crown.charts import chart_vertices, ring_table
from sphericalvision.crown.hexagons import CHART_RINGS, NORTH_RINGS, Rings, two_orientations
from sphericalvision.crown.places import as_rectangles, level_of_rectangles, place_ids
from sphericalvision.crown.statistics import CrownNorm
from sphericalvision.crown.taps import COL_TAPS, convolve_rectangles
from sphericalvision.geometry.means_by_id import MeansById, mean_by_id, means_by_id
from sphericalvision.icosphere import level_from_num_vertices, num_icosphere_vertices
from sphericalvision.icosphere.topology import coarse_vertex_ids
from sphericalvision.kernels import is_traced
from sphericalvision.tables import constant_table

LARGE = 1 << 20
"""Values from which memory, and not the launch, is what the continuation of a border takes."""


def unfold(
    values: Num[Tensor, "B C *N V"],
) -> tuple[Num[Tensor, "B 5 C *N long short"], Num[Tensor, "B 5 C *N short long"]]:
    """Look values up at the places of all rectangles, as ``places.values_at_places`` does."""
    if is_traced():  # which differentiate lookups themselves
        return NotImplemented
    return as_rectangles(_Unfold.apply(values), level_from_num_vertices(values.shape[-1]))


def fold(
    col: Float[Tensor, "B 5 C *N long short"], row: Float[Tensor, "B 5 C *N short long"]
) -> Float[Tensor, "B C *N V"]:
    """Return the mean of each vertex over all its places, as ``places.mean_over_places`` does."""
    ids = torch.cat([rectangles.flatten(-2).movedim(1, -2) for rectangles in (col, row)], -2).flatten(-2)
    level = level_of_rectangles(col)
    if is_traced():
        return mean_by_id(ids, _means(level, ids.dtype, ids.device)[0])
    return _Fold.apply(ids, level)  # type: ignore[no-any-return]


@constant_table
def _means(level: int, dtype: torch.dtype, device: torch.device) -> tuple[MeansById, Tensor]:
    """Where the places of each vertex are, and their number."""
    ids, number = place_ids(level, device).flatten(), num_icosphere_vertices(level)
    return means_by_id(ids, number, dtype), ids.bincount(minlength=number).to(dtype)


class _Unfold(torch.autograd.Function):
    """Values ``(*, V)`` at all places ``(*, P)``: the derivative is looked up as well, where torch would add up."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        ctx.level = level_from_num_vertices(values.shape[-1])
        return values.index_select(-1, place_ids(ctx.level, values.device).flatten())

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (gradient,) = gradients
        _, counts = _means(ctx.level, gradient.dtype, gradient.device)
        return _Fold.apply(gradient, ctx.level) * counts  # type: ignore[no-any-return]


class _Fold(torch.autograd.Function):
    """The mean ``(*, V)`` of what is at the places ``(*, P)`` of each vertex."""

    @staticmethod
    def forward(ctx: Any, places: Tensor, level: int) -> Tensor:
        return mean_by_id(places, _means(level, places.dtype, places.device)[0])

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        (gradient,) = gradients
        _, counts = _means(level_from_num_vertices(gradient.shape[-1]), gradient.dtype, gradient.device)
        return _Unfold.apply(gradient / counts), None


def convolve_with_joined_border(
    col: Tensor, row: Tensor, weight: Tensor, bias: Tensor | None = None, stride: int = 1, relu: bool = False
) -> tuple[Tensor, Tensor]:
    """Convolve rectangles whose borders are joined on, where Inductor has to differentiate.

    It expects another memory format of the gradient of a padding than it gets.
    """
    # One pad is fewer operators than this.
    if col.ndim != 5 or not torch.is_grad_enabled() or not is_traced():
        return NotImplemented
    return convolve_rectangles(col, row, weight, bias, stride, relu, _join_border)


def _join_border(images: Tensor) -> Tensor:
    tall = torch.cat((images[..., :1, :], images, images[..., -1:, :]), -2)
    return torch.cat((tall[..., :1], tall, tall[..., -1:]), -1)


def convolve_with_border_in_triton(
    col: Tensor, row: Tensor, weight: Tensor, bias: Tensor | None = None, stride: int = 1, relu: bool = False
) -> tuple[Tensor, Tensor]:
    """Convolve large rectangles, whose borders a kernel repeats."""
    if col.numel() < LARGE:
        return NotImplemented
    from sphericalvision.crown.fast.border_triton import RepeatBorder  # Triton is not everywhere

    return convolve_rectangles(col, row, weight, bias, stride, relu, RepeatBorder.apply)


def normalize(col: Tensor, row: Tensor, norm: CrownNorm, relu: bool) -> tuple[Tensor, Tensor]:
    """Normalise each sample by itself: a group for each channel, where others have a batch of all their channels."""
    if not norm.per_sample:
        return NotImplemented
    together = torch.cat([rectangles.transpose(1, 2).flatten(-2) for rectangles in (col, row)], 2)
    normalized = F.group_norm(together, norm.num_features, norm.weight, norm.bias, norm.eps)
    normalized = normalized.relu() if relu else normalized
    first, second = normalized.transpose(1, 2).split(5, 1)
    return first.unflatten(-1, col.shape[-2:]), second.unflatten(-1, row.shape[-2:])


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


def hexagons2d(
    values: Float[Tensor, "B C_in *N V"],
    weight: Float[Tensor, "C_out C_in taps"],
    bias: Float[Tensor, " C_out"] | None,
    stride: int,
    north: Float[Tensor, " V"] | None,
    rectify: bool = False,
    residual: Float[Tensor, "B C_out V_out"] | None = None,
) -> Float[Tensor, "B C_out V_out"]:
    """Convolve values as ``hex_conv2d`` does: look the seven taps of every vertex up, then multiply."""
    if values.ndim != 3:  # volumes
        return NotImplemented
    values = values.relu() if rectify else values
    if north is None:
        result = _multiply_taps(values, weight, bias, stride, CHART_RINGS)
    else:
        pair = _multiply_taps(values, *two_orientations(weight, bias), stride, NORTH_RINGS)
        before, after = pair.chunk(2, 1)
        result = torch.lerp(before, after, _fractions(north, stride).to(pair))  # of another type in autocast
    return result if residual is None else residual + result


def _fractions(north: Tensor, stride: int) -> Tensor:
    level = level_from_num_vertices(len(north))
    return north if stride == 1 else north[coarse_vertex_ids(level, north.device)]


def _multiply_taps(values: Tensor, weight: Tensor, bias: Tensor | None, stride: int, rings: Rings) -> Tensor:
    tables = _tap_tables(level_from_num_vertices(values.shape[-1]), stride, rings, values.device)
    read = values.index_select(-1, tables.reads)
    means = read[..., -63:-3].unflatten(-1, (12, 5)).mean(-1)
    read.index_copy_(-1, tables.gaps, means)
    # The seven values of a vertex are in a row, so a convolution of stride seven takes the weights as they are.
    return F.conv1d(read, weight, bias, stride=7)[..., :-9]


def hexagons_in_triton(
    values: Float[Tensor, "B C_in *N V"],
    weight: Float[Tensor, "C_out C_in taps"],
    bias: Float[Tensor, " C_out"] | None,
    stride: int,
    north: Float[Tensor, " V"] | None,
    rectify: bool = False,
    residual: Float[Tensor, "B C_out V_out"] | None = None,
) -> Float[Tensor, "B C_out V_out"]:
    """Convolve values in single precision as ``hex_conv2d`` does, by a kernel that never writes what the taps read."""
    tensors = [tensor for tensor in (values, weight, bias, residual) if tensor is not None]
    is_cast = torch.is_autocast_enabled("cuda") or any(tensor.dtype != torch.float32 for tensor in tensors)
    if is_cast or values.ndim != 3:
        return NotImplemented
    from sphericalvision.crown.fast.hexconv_triton import hex_conv_kernel  # Triton is not everywhere

    level = level_from_num_vertices(values.shape[-1])
    if north is None:
        tables = _tap_tables(level, stride, CHART_RINGS, values.device)
        return hex_conv_kernel(values, weight, bias, tables.around, tables.taps, rectify, residual)
    tables = _tap_tables(level, stride, NORTH_RINGS, values.device)
    values = values.relu() if rectify else values
    pair = hex_conv_kernel(values, *two_orientations(weight, bias), tables.around, tables.taps)
    before, after = pair.chunk(2, 1)
    result = torch.lerp(before, after, _fractions(north, stride).to(pair))
    return result if residual is None else residual + result


@constant_table
def _tap_tables(level: int, stride: int, rings: Rings, device: torch.device) -> TapTables:
    number, n = num_icosphere_vertices(level), 2**level
    charts, special = chart_vertices(level, device), ring_table(level, device)
    ids = [sum(COL_TAPS, ()).index(tap) for tap in range(7)]  # places of the taps in a planar kernel
    own = torch.stack(
        [charts[:, place // 3 : place // 3 + 2 * n, place % 3 : place % 3 + n] for place in ids], -1
    )
    taps = special.new_empty(number, 7)
    taps[1:-1] = own.view(-1, 7)
    means = number + torch.arange(12, device=device)[:, None]
    taps[special[:, 5:], torch.tensor(rings, device=device)] = torch.cat((special[:, :5], means), 1)
    taps[special[:, 5], 6] = special[:, 5]
    taps = (taps if stride == 1 else taps[coarse_vertex_ids(level, device)]).flatten()
    around = special[:, :5].flatten()
    is_gap = taps >= number
    gaps = is_gap.nonzero()[:, 0]
    reads = torch.cat((taps.masked_fill(is_gap, 0), around, around[:3]))
    return TapTables(taps, around, reads, gaps[taps[gaps].argsort()])
