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

from functools import lru_cache

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sphericalvision.core import ArgumentError, ShapeError, check_choice, check_dtype
from sphericalvision.crown.charts import chart_vertices
from sphericalvision.crown.fast import hex_convolve
from sphericalvision.crown.taps import HexagonWeights, check_stride
from sphericalvision.icosphere import icosphere_vertices, level_from_num_vertices
from sphericalvision.shapes import check_shapes

ORIENTATIONS = ("chart", "north")


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
    charts = icosphere_vertices(level, torch.float64)[chart_vertices(level, torch.device("cpu"))]
    # Of the neighbours of taps 5 and 0, which are north and west in the chart.
    center, up, neighbor = charts[:, 1:-1, 1:-1], charts[:, :-2, 1:-1], charts[:, 1:-1, :-2]
    north = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64).expand_as(center)

    def angle(start: Tensor, end: Tensor) -> Tensor:
        """Angle at the centre from one direction to another, counter-clockwise from inside."""
        flat_start, flat_end = (v - (v * center).sum(-1, keepdim=True) * center for v in (start, end))
        turned = (torch.linalg.cross(flat_end, flat_start) * center).sum(-1)
        return torch.atan2(turned, (flat_start * flat_end).sum(-1))

    fraction = (angle(up, north) / angle(up, neighbor)).clamp(0, 1)
    # At vertices of valence five the two neighbours are none of a hexagon's: `NORTH_RINGS` turns their taps.
    fraction[:, n - 1 :: n, 0] = 0
    return F.pad(fraction.flatten(), (1, 1))


@check_shapes
def hex_conv2d(
    values: Float[Tensor, "B C_in V"],
    weight: Float[Tensor, "C_out C_weight 7"],
    bias: Float[Tensor, " C_out"] | None = None,
    stride: int = 1,
    north: Float[Tensor, " V_north"] | None = None,
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
    _check_conv(values, weight, stride, north)
    return hex_convolve(values, weight, bias, stride, north, rectify, residual)


@check_shapes
def hex_conv3d(
    values: Float[Tensor, "B C_in N V"],
    weight: Float[Tensor, "C_out C_weight 21"],
    bias: Float[Tensor, " C_out"] | None = None,
    stride: int = 1,
    north: Float[Tensor, " V_north"] | None = None,
) -> Float[Tensor, "B C_out N V_out"]:
    """Convolve volumes on an icosphere with seven taps at three neighbouring hypotheses; all N hypotheses are kept.

    As ``hex_conv2d``, from values ``(B, in, N, V)`` to ``(B, out, N, V)`` with the weight ``(out, in, 21)``, index
    ``7 * depth + tap``. The first and the last hypothesis are repeated beyond the ends.

    Examples:
        >>> hex_conv3d(torch.ones(1, 4, 16, 42), torch.ones(8, 4, 21)).shape
        torch.Size([1, 8, 16, 42])
    """
    _check_conv(values, weight, stride, north)
    return hex_convolve(values, weight, bias, stride, north)


def _check_conv(values: Tensor, weight: Tensor, stride: int, north: Tensor | None) -> None:
    """Raise unless level, type, channels and stride fit, which annotations do not check."""
    level = level_from_num_vertices(values.shape[-1])
    check_dtype("values", values, weight)
    if weight.shape[1] != values.shape[1]:
        raise ShapeError(f"values: expected {weight.shape[1]} channels (dimension 1), got {values.shape[1]}")
    check_stride(stride, level)
    if north is not None and len(north) != values.shape[-1]:
        raise ShapeError(
            f"values: expected level {level_from_num_vertices(len(north))}, that of the layer's orientation from "
            f"north, got level {level}, shape {tuple(values.shape)}"
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
        super().__init__(in_channels, out_channels, stride, bias, kernel_size=kernel_size)
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
