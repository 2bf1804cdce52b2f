# SPDX-License-Identifier: Apache-2.0
"""Hexagonal convolutions on the vertices of an icosphere, with true neighbours everywhere.

Taps 0 to 5 go round the centre, tap 6, counter-clockwise as panoramas are seen, from inside. In a chart they are
``[[., 5, 4], [0, 6, 3], [1, 2, .]]``, the order of ``CrownConv2d``. What "north" is for them is the orientation:

``chart`` (``north=None``)
    Taps follow the axes of the chart that owns the vertex: tap 4 points east along the belt, and north is halfway
    between taps 5 and 0. Towards the poles north drifts from this middle to tap 5 at the west edge of a chart and to
    tap 0 at the east edge, 30° each way, so that orientation jumps by 60° where two polar faces meet.
``north`` (``north=north_fraction(level)``)
    Tap 5 points north at every vertex but the poles. The value of a tap is interpolated along the arc between the two
    neighbours at its sides; this is the mean of two convolutions, and orientation jumps nowhere.

The twelve vertices of valence five have five neighbours and a gap. The tap of the gap reads their mean:

==============  ================================  =======================================
vertex          ``chart``: gap, first neighbour   ``north``: gap, first neighbour
==============  ================================  =======================================
north pole      tap 1, tap 2 towards A(0)         tap 5, tap 2 towards A(0)
A(k)            tap 0, tap 5 towards the pole     tap 2, tap 5 towards the pole
B(k)            tap 2, tap 3 towards the pole     tap 5, tap 2 towards the pole
south pole      tap 4, tap 5 towards B(1)         tap 5, tap 2 towards B(3)
==============  ================================  =======================================

At a pole, north is the limit along the meridian of longitude zero. So the sum over the ring is 6/5 of the sum over the
five neighbours: constants stay constants, and a kernel of a centre and six equal taps commutes with all rotations
of the icosahedron.
"""

from __future__ import annotations

import math
from functools import lru_cache

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sphericalvision.core import ArgumentError, ShapeError, check_choice, check_dtype, check_tensor
from sphericalvision.crown.by_lookups import Rings, hex_conv_by_lookups
from sphericalvision.crown.fast import convolve_charts, convolve_rectangles
from sphericalvision.crown.hexpad import fill_charts, hex_pad, ring_values, vertices_of_charts
from sphericalvision.crown.places import check_values
from sphericalvision.crown.taps import COL_TAPS, HexagonWeights
from sphericalvision.icosphere import icosphere_vertices, level_from_num_vertices
from sphericalvision.icosphere.topology import coarse_vertex_ids, vertex_at
from sphericalvision.kernels import prefer_fused
from sphericalvision.tables import constant_table

__all__ = ["HexConv2d", "HexConv3d", "hex_conv2d", "hex_conv3d", "north_fraction"]

ORIENTATIONS = ("chart", "north")

# Taps of the five neighbours in the order of ``ring_ids``, then the tap of the gap, at north pole, A, B, south pole.
CHART_RINGS = ((2, 3, 4, 5, 0, 1), (1, 2, 3, 4, 5, 0), (3, 4, 5, 0, 1, 2), (5, 0, 1, 2, 3, 4))
NORTH_RINGS = ((2, 3, 4, 0, 1, 5), (0, 1, 3, 4, 5, 2), (2, 3, 4, 0, 1, 5), (4, 0, 1, 2, 3, 5))


def north_fraction(
    level: int, dtype: torch.dtype | None = None, device: torch.device | str | None = None
) -> Float[Tensor, " V"]:
    """Return where north lies between the neighbours of taps 5 (0) and 0 (1) in the chart of a vertex, ``(V,)``.

    The fraction is that of angles in the tangent plane. At the twelve vertices of valence five it is 0 and not used.

    References:
        Zhang et al. (2019), "Orientation-aware semantic segmentation on icosahedron spheres", section 3.2.

    Examples:
        >>> fraction = north_fraction(3)[1:-1].view(5, 16, 8)
        >>> fraction[0, 3]  # from the west edge of a polar face into the belt, where north is halfway
        tensor([0.0000, 0.1850, 0.3219, 0.4354, 0.5000, 0.4637, 0.4990, 0.5334])
    """
    return _north_fraction(level).to(dtype=dtype or torch.get_default_dtype(), device=device)


@lru_cache(maxsize=16)
def _north_fraction(level: int) -> Tensor:
    n = 2**level
    vertices = icosphere_vertices(level, torch.float64)
    chart = torch.arange(5)[:, None, None]
    row, column = torch.arange(1, 2 * n + 1)[:, None], torch.arange(n)
    center, up = (vertices[vertex_at(chart, row - step, column, level)] for step in (0, 1))
    # West of column 0 lies the first row of the chart before, then its last column.
    west_row = torch.where(row <= n, 1, row - n)
    west_column = torch.where(row <= n, row - 1, n - 1)
    at_edge = column == 0
    left = vertices[
        vertex_at(
            torch.where(at_edge, (chart - 1) % 5, chart),
            torch.where(at_edge, west_row, row),
            torch.where(at_edge, west_column, column - 1),
            level,
        )
    ]
    north = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64).expand_as(center)

    def angle(start: Tensor, end: Tensor) -> Tensor:
        """Angle at the centre from one direction to another, counter-clockwise from inside."""
        flat_start, flat_end = (v - (v * center).sum(-1, keepdim=True) * center for v in (start, end))
        turned = (torch.linalg.cross(flat_end, flat_start) * center).sum(-1)
        return torch.atan2(turned, (flat_start * flat_end).sum(-1))

    fraction = (angle(up, north) / angle(up, left)).clamp(0, 1)
    # At vertices of valence five the two neighbours are none of a hexagon's: `NORTH_RINGS` turns their taps instead.
    fraction[:, n - 1 :: n, 0] = 0
    return F.pad(fraction.flatten(), (1, 1))


def hex_conv2d(
    values: Float[Tensor, "B C_in V"],
    weight: Float[Tensor, "C_out C_in 7"],
    bias: Float[Tensor, " C_out"] | None = None,
    stride: int = 1,
    north: Float[Tensor, " V"] | None = None,
    rectify: bool = False,
    residual: Float[Tensor, "B C_out V_out"] | None = None,
) -> Float[Tensor, "B C_out V_out"]:
    """Convolve values on an icosphere with seven taps: each vertex and its six true neighbours.

    Args:
        values: ``(B, in, V)``; the level follows from V.
        weight: ``(out, in, 7)``, see the module for the order of taps.
        bias: ``(out,)``.
        stride: 1, or 2 to keep the vertices of the next coarser level.
        north: ``north_fraction(level)`` of this level for taps aligned with north; without it they follow the charts.
        rectify: whether values pass a ReLU first.
        residual: is added to the result.

    Returns:
        ``(B, out, V)``, or of the next coarser level; channels are the fastest dimension in memory.

    Raises:
        ShapeError: if values, weight or north do not fit.
        ArgumentError: if the stride is neither 1 nor 2, or 2 at level 0.

    References:
        Zhang et al. (2019), "Orientation-aware semantic segmentation on icosahedron spheres"; Lee et al. (2019),
        "SpherePHD".

    Examples:
        >>> hex_conv2d(torch.ones(1, 4, 162), torch.ones(8, 4, 7), stride=2).shape
        torch.Size([1, 8, 42])
    """
    _check_conv(values, weight, 2, stride, north)
    if north is None and prefer_fused(values.device):
        return hex_conv_by_lookups(values, weight, bias, stride, CHART_RINGS, rectify, residual)
    result = _hex_conv2d(values.relu() if rectify else values, weight, bias, stride, north)
    return result if residual is None else residual + result


def _hex_conv2d(
    values: Tensor, weight: Tensor, bias: Tensor | None, stride: int, north: Tensor | None
) -> Tensor:
    if north is not None and prefer_fused(values.device):
        both = hex_conv_by_lookups(values, *_two_orientations(weight, bias), stride, NORTH_RINGS)
        fraction = north.to(both)  # of another type than the values in autocast
        if stride == 2:
            fraction = fraction[coarse_vertex_ids(level_from_num_vertices(len(north)), north.device)]
        along, next_one = both.chunk(2, 1)
        return torch.lerp(along, next_one, fraction)
    own, rings = _own_and_rings(values, weight, bias, stride, north)
    # The twelve vertices of valence five: what each tap reads of their rings, then one product with all taps.
    special = torch.einsum("bivj,vjt->bvit", rings, _ring_weights(rings, north)).flatten(2)
    special = (special @ weight.flatten(1).T).mT
    return fill_charts(own, special if bias is None else special + bias[:, None])


def hex_conv3d(
    values: Float[Tensor, "B C_in N V"],
    weight: Float[Tensor, "C_out C_in 21"],
    bias: Float[Tensor, " C_out"] | None = None,
    stride: int = 1,
    north: Float[Tensor, " V"] | None = None,
) -> Float[Tensor, "B C_out N V_out"]:
    """Convolve volumes on an icosphere with seven taps at three neighbouring hypotheses.

    Before the first and after the last hypothesis these are repeated.

    Args:
        values: ``(B, in, N, V)``; the level follows from V.
        weight: ``(out, in, 21)``, index ``7 * depth + tap``.
        bias: ``(out,)``.
        stride: 1, or 2 to keep the vertices of the next coarser level; all N hypotheses are kept.
        north: ``north_fraction(level)`` of this level for taps aligned with north; without it they follow the charts.

    Returns:
        ``(B, out, N, V)``, or of the next coarser level.

    Raises:
        ShapeError: if values, weight or north do not fit.
        ArgumentError: if the stride is neither 1 nor 2, or 2 at level 0.

    Examples:
        >>> hex_conv3d(torch.ones(1, 4, 16, 42), torch.ones(8, 4, 21)).shape
        torch.Size([1, 8, 16, 42])
    """
    _check_conv(values, weight, 3, stride, north)
    own, rings = _own_and_rings(values, weight, bias, stride, north)
    windows = _repeat_ends(rings).unfold(2, 3, 1)  # three hypotheses for each, a view
    special = torch.einsum("binvjd,vjt->bnvidt", windows, _ring_weights(rings, north)).flatten(3)
    special = (special @ weight.flatten(1).T).permute(0, 3, 1, 2)
    return fill_charts(own, special if bias is None else special + bias[:, None, None])


def _repeat_ends(values: Tensor) -> Tensor:
    """Repeat the first and the last hypothesis of values ``(B, C, N, *)``."""
    return torch.cat((values[:, :, :1], values, values[:, :, -1:]), 2)


def _own_and_rings(
    values: Tensor, weight: Tensor, bias: Tensor | None, stride: int, north: Tensor | None
) -> tuple[Tensor, Tensor]:
    """What charts own, convolved, or between two neighbouring orientations; and the rings of the special vertices."""
    fraction = _own_fraction(north, values, stride)
    if fraction is not None:
        weight, bias = _two_orientations(weight, bias)
    own = convolve_charts(values, weight, bias, vertices_of_charts) if stride == 1 else None
    if own is not None:
        rings = ring_values(values)
    else:
        charts, rings = hex_pad(values)
        charts = charts[..., stride - 1 :, :]  # a coarser chart begins at the second row of the finer one
        own = convolve_rectangles(charts, weight, COL_TAPS, bias, stride, border=True)
    if fraction is None:  # taps follow the chart
        return own, rings
    along, next_one = own.chunk(2, 2)
    return torch.lerp(along, next_one, fraction.to(own)), rings


def _two_orientations(weight: Tensor, bias: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """Kernels of two convolutions, for north lies between two neighbours.

    One has the kernel as it is, with tap 5 on the neighbour before, the other has it turned on by one neighbour, and
    each vertex goes its own fraction from one to the other.
    """
    turned = turned_on(weight.unflatten(-1, (-1, 7))).flatten(2)
    return torch.cat((weight, turned)), None if bias is None else bias.repeat(2)


def turned_on(kernels: Float[Tensor, "*filters 7"]) -> Float[Tensor, "*filters 7"]:
    """Turn kernels ``(*, 7)`` on by one neighbour.

    Examples:
        >>> turned_on(torch.arange(7))
        tensor([5, 0, 1, 2, 3, 4, 6])
    """
    return torch.cat((kernels[..., :6].roll(1, -1), kernels[..., 6:]), -1)


def _own_fraction(north: Tensor | None, values: Tensor, stride: int) -> Tensor | None:
    """View ``(V,)`` as what charts own and the stride keeps, ``(5, 1, [1,] rows, columns)``."""
    if north is None:
        return None
    n = math.isqrt((values.shape[-1] - 2) // 10)
    charts = north[1:-1].view(5, *(1,) * (values.ndim - 2), 2 * n, n)
    return charts[..., stride - 1 :: stride, ::stride]


def _ring_weights(like: Tensor, north: Tensor | None) -> Tensor:
    return _taps_of_rings(CHART_RINGS if north is None else NORTH_RINGS, like.dtype, like.device)


@constant_table
def _taps_of_rings(rings: Rings, dtype: torch.dtype, device: torch.device) -> Tensor:
    """What each tap of the twelve special vertices reads of their rings, ``(12, 6, 7)``.

    Values are brought to the taps, not weights to the rings, which are many more.
    """
    pole_north, a, b, pole_south = rings
    taps = torch.tensor((pole_north, *(a, b) * 5, pole_south), device=device)
    of_tap = torch.eye(7, dtype=dtype, device=device)
    neighbors = of_tap[taps[:, :5]] + of_tap[taps[:, 5:]] / 5  # each has its share of the mean in the gap
    return torch.cat((neighbors, of_tap[6].expand(12, 1, 7)), 1)


def _check_conv(values: Tensor, weight: Tensor, spatial_dims: int, stride: int, north: Tensor | None) -> None:
    level = check_values(values, spatial_dims)
    taps = 7 if spatial_dims == 2 else 21
    check_tensor("weight", weight, f"(out, in, {taps})")
    check_dtype("values", values, weight)
    if weight.ndim != 3 or weight.shape[-1] != taps:
        raise ShapeError(f"weight: expected shape (out, in, {taps}), got {tuple(weight.shape)}")
    if weight.shape[1] != values.shape[1]:
        raise ShapeError(f"values: expected {weight.shape[1]} channels (dimension 1), got {values.shape[1]}")
    if stride not in (1, 2) or (stride == 2 and level == 0):
        raise ArgumentError(f"stride: expected 1, or 2 above level 0, got {stride} at level {level}")
    if north is not None and tuple(north.shape) != (values.shape[-1],):
        raise ShapeError(
            f"north: expected north_fraction({level}) of shape ({values.shape[-1]},), got {tuple(north.shape)}"
        )


class _HexConv(HexagonWeights):
    """Weights and orientation of a hexagonal convolution."""

    north: Tensor | None

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        stride: int = 1,
        bias: bool = False,
        orientation: str = "chart",
        level: int | None = None,
        *,
        kernel_size: None = None,
    ) -> None:
        super().__init__(in_channels, out_channels, stride, bias, kernel_size)
        check_choice("orientation", orientation, ORIENTATIONS)
        if orientation == "north" and level is None:
            raise ArgumentError("level: expected the level of the values for orientation 'north', got None")
        self.orientation, self.level = orientation, level
        north = north_fraction(level) if orientation == "north" and level is not None else None
        self.register_buffer("north", north, persistent=False)

    def extra_repr(self) -> str:
        level = "" if self.level is None else f", level={self.level}"
        return f"{super().extra_repr()}, orientation={self.orientation!r}{level}"


class HexConv2d(_HexConv):
    """Hexagonal convolution of values ``(B, C, V)`` on an icosphere, true neighbours everywhere.

    Args:
        in_channels: channels of the values given.
        out_channels: channels of the values returned.
        stride: 1, or 2 to keep the vertices of the next coarser level.
        bias: whether to add a learned bias.
        orientation: ``"chart"``, one convolution whose taps follow the charts, within 30° of north; or ``"north"``,
            aligned with north by interpolation, at the price of two.
        level: of the values given; needed for ``"north"`` only.
        kernel_size: is refused: a kernel is a vertex and its neighbours.

    Examples:
        >>> HexConv2d(3, 32, stride=2)
        HexConv2d(3, 32, stride=2, bias=False, orientation='chart')
        >>> HexConv2d(3, 8, orientation="north", level=2)(torch.rand(2, 3, 162)).shape
        torch.Size([2, 8, 162])
    """

    taps = 7

    def forward(
        self,
        values: Float[Tensor, "B C_in V"],
        rectify: bool = False,
        residual: Float[Tensor, "B C_out V_out"] | None = None,
    ) -> Float[Tensor, "B C_out V_out"]:
        return hex_conv2d(values, self.weight, self.bias, self.stride, self.north, rectify, residual)


class HexConv3d(_HexConv):
    """Hexagonal convolution of volumes ``(B, C, N, V)`` with weight ``(out, in, 21)``; see ``hex_conv3d``.

    Arguments are those of ``HexConv2d``; hypotheses are always kept.

    Examples:
        >>> HexConv3d(64, 32)
        HexConv3d(64, 32, stride=1, bias=False, orientation='chart')
    """

    taps = 21

    def forward(self, values: Float[Tensor, "B C_in N V"]) -> Float[Tensor, "B C_out N V_out"]:
        return hex_conv3d(values, self.weight, self.bias, self.stride, self.north)
