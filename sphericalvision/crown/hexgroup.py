# SPDX-License-Identifier: Apache-2.0
"""Hexagonal convolutions in six orientations at once, equivariant to turns of 60°.

A hexagonal lattice maps onto itself by turns of 60°, a square one by 90° only, and on an icosphere such a turn of the
kernel takes no interpolation. ``HexLiftConv2d`` convolves with each kernel in six orientations, ``HexGroupConv2d`` its
results ``(B, C, 6, V)``: its kernel has values for each orientation relative to its own, and turns as a whole. If the
picture turns by 60°, values turn with it and move on by one orientation; their maximum or mean over the six turns, too,
and is otherwise the same.

``nn.BatchNorm2d``, ``nn.ReLU`` and ``IcospherePool`` take such values as they are. Orientations are counted from north.
Near a pole north differs from one vertex to the next, and values of neighbours are in frames that are turned against
each other: there the statement holds less well.

References:
    T. Cohen, M. Welling, "Group equivariant convolutional networks", ICML 2016; E. Hoogeboom et al., "HexaConv", ICLR
    2018 (p6); T. Cohen et al., "Gauge equivariant convolutional networks and the icosahedral CNN", ICML 2019.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sphericalvision.crown.hexagons import turned_on
from sphericalvision.crown.hexconv import hex_conv2d, north_fraction
from sphericalvision.shapes import check_shapes

ORIENTATIONS = 6


@check_shapes
def hex_lift_conv2d(
    values: Float[Tensor, "B C_in V"],
    weight: Float[Tensor, "C_out C_weight 7"],
    stride: int = 1,
    north: Float[Tensor, " V_north"] | None = None,
) -> Float[Tensor, "B C_out 6 V_out"]:
    """Convolve values with each kernel in six orientations; the k-th is turned by k neighbours, clockwise from outside.

    Args:
        values: ``(B, in, V)``.
        weight: ``(out, in, 7)``, taps as in ``hex_conv2d``.
        stride: 1, or 2 to keep the vertices of the next coarser level.
        north: ``north_fraction(level)``, from which orientations are counted; without it they follow the charts.

    Raises:
        ShapeError: if values, weight or north do not fit.
        ArgumentError: if the stride is neither 1 nor 2, or 2 at level 0.

    Examples:
        >>> hex_lift_conv2d(torch.ones(1, 3, 162), torch.ones(8, 3, 7)).shape
        torch.Size([1, 8, 6, 162])
    """
    kernels = torch.stack(_turns(weight), 1).flatten(0, 1)
    return hex_conv2d(values, kernels, None, stride, north).unflatten(1, (-1, ORIENTATIONS))


@check_shapes
def hex_group_conv2d(
    values: Float[Tensor, "B C_in 6 V"],
    weight: Float[Tensor, "C_out C_weight 6 7"],
    stride: int = 1,
    north: Float[Tensor, " V_north"] | None = None,
) -> Float[Tensor, "B C_out 6 V_out"]:
    """Convolve values in six orientations with kernels that turn in the plane and through the orientations.

    As ``hex_lift_conv2d``, with values ``(B, in, 6, V)`` and the weight ``(out, in, 6, 7)``: in orientation 0, what
    each orientation of the values contributes by each tap.

    Examples:
        >>> hex_group_conv2d(torch.ones(1, 4, 6, 162), torch.ones(8, 4, 6, 7), stride=2).shape
        torch.Size([1, 8, 6, 42])
    """
    turned = [kernel.roll(k, 2) for k, kernel in enumerate(_turns(weight))]
    kernels = torch.stack(turned, 1).flatten(2, 3).flatten(0, 1)
    result = hex_conv2d(values.flatten(1, 2), kernels, None, stride, north)
    return result.unflatten(1, (-1, ORIENTATIONS))


def _turns(weight: Tensor) -> list[Tensor]:
    """Kernels ``(*, 7)`` turned by 0 to 5 neighbours."""
    turned = [weight]
    for _ in range(ORIENTATIONS - 1):
        turned.append(turned_on(turned[-1]))
    return turned


class _HexOriented(nn.Module):
    """Weights of a convolution in six orientations from north."""

    north: Tensor

    def __init__(self, shape: tuple[int, ...], stride: int, level: int) -> None:
        super().__init__()
        self.stride, self.level = stride, level
        self.weight = nn.Parameter(torch.empty(shape))
        self.register_buffer("north", north_fraction(level), persistent=False)
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Draw weights as ``torch.nn.Conv2d`` does, for a fan-in of all that a result is a sum of."""
        bound = 1 / math.sqrt(self.weight[0].numel())
        nn.init.uniform_(self.weight, -bound, bound)

    def extra_repr(self) -> str:
        return f"{self.weight.shape[1]}, {self.weight.shape[0]}, level={self.level}, stride={self.stride}"


class HexLiftConv2d(_HexOriented):
    """The first layer of a network in six orientations, ``(B, C, V)`` to ``(B, C, 6, V)``; see ``hex_lift_conv2d``.

    Args:
        in_channels: channels of the values given.
        out_channels: channels of the values returned, in six orientations each.
        level: of the values given.
        stride: 1, or 2 to keep the vertices of the next coarser level.

    Examples:
        >>> from sphericalvision.icosphere import IcospherePool
        >>> network = nn.Sequential(
        ...     HexLiftConv2d(1, 4, level=3), nn.BatchNorm2d(4), nn.ReLU(),
        ...     IcospherePool(3), HexGroupConv2d(4, 8, level=2),
        ... )
        >>> network(torch.rand(2, 1, 642)).amax(2).shape  # the strongest of six orientations
        torch.Size([2, 8, 162])
    """

    def __init__(self, in_channels: int, out_channels: int, level: int, stride: int = 1) -> None:
        super().__init__((out_channels, in_channels, 7), stride, level)

    def forward(self, values: Float[Tensor, "B C_in V"]) -> Float[Tensor, "B C_out 6 V_out"]:
        return hex_lift_conv2d(values, self.weight, self.stride, self.north)


class HexGroupConv2d(_HexOriented):
    """A layer of a network in six orientations, ``(B, C, 6, V)`` to the same; see ``hex_group_conv2d``.

    Arguments are those of ``HexLiftConv2d``.

    Examples:
        >>> HexGroupConv2d(8, 16, level=2)(torch.rand(2, 8, 6, 162)).shape
        torch.Size([2, 16, 6, 162])
    """

    def __init__(self, in_channels: int, out_channels: int, level: int, stride: int = 1) -> None:
        super().__init__((out_channels, in_channels, ORIENTATIONS, 7), stride, level)

    def forward(self, values: Float[Tensor, "B C_in 6 V"]) -> Float[Tensor, "B C_out 6 V_out"]:
        return hex_group_conv2d(values, self.weight, self.stride, self.north)
