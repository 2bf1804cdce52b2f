# SPDX-License-Identifier: Apache-2.0
"""Hexagonal convolutions on a crown: the centre and six neighbours, turned to fit each kind of rectangle."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from sphericalvision.core import check_dtype
from sphericalvision.crown.fast import convolve_rectangles, convolve_vertices
from sphericalvision.crown.layout import Crown, check_crown
from sphericalvision.crown.taps import HexagonWeights, check_stride
from sphericalvision.shapes import check_shapes


def _check_conv(crown: Crown, weight: Tensor, spatial_dims: int, stride: int) -> None:
    check_crown(crown, spatial_dims, weight.shape[1])
    check_dtype("crown", crown.col, weight)
    check_stride(stride, crown.level)


@check_shapes
def crown_conv2d(
    crown: Crown,
    weight: Float[Tensor, "C_out C_in 7"],
    bias: Float[Tensor, " C_out"] | None = None,
    stride: int = 1,
) -> Crown:
    """Convolve a crown with seven taps; borders are continued by their own values.

    The taps of a col rectangle are ``[[., 5, 4], [0, 6, 3], [1, 2, .]]``, of a row rectangle
    ``[[., 0, 5], [1, 6, 4], [2, 3, .]]``: the same directions on the sphere up to a sixth of a turn.

    Args:
        crown: rectangles ``(B, 5, in, h, w)``.
        weight: ``(out, in, 7)``, shared by all rectangles.
        bias: ``(out,)``.
        stride: 1, or 2 to keep the vertices of the next coarser level.

    Raises:
        ShapeError: if the crown, its channels or the weight do not fit.
        ArgumentError: if the stride is neither 1 nor 2, or 2 at level 0.

    References:
        Komatsu et al. (2020), CrownConv; Hoogeboom et al. (2018), "HexaConv".

    Examples:
        >>> import torch
        >>> from sphericalvision.crown import to_crown
        >>> crown_conv2d(to_crown(torch.ones(1, 4, 42)), torch.ones(8, 4, 7), stride=2).col.shape
        torch.Size([1, 5, 8, 3, 2])
    """
    _check_conv(crown, weight, 2, stride)
    return convolve_crown(crown, weight, bias, stride)


@check_shapes
def crown_conv3d(
    crown: Crown,
    weight: Float[Tensor, "C_out C_in 21"],
    bias: Float[Tensor, " C_out"] | None = None,
    stride: int = 1,
) -> Crown:
    """Convolve a crown of volumes with seven taps at three neighbouring hypotheses; all N hypotheses are kept.

    As ``crown_conv2d``, with rectangles ``(B, 5, in, N, h, w)`` and the weight ``(out, in, 21)``, index
    ``7 * depth + tap``.

    Examples:
        >>> import torch
        >>> from sphericalvision.crown import to_crown
        >>> crown_conv3d(to_crown(torch.ones(1, 4, 16, 42)), torch.ones(8, 4, 21)).row.shape
        torch.Size([1, 5, 8, 16, 3, 5])
    """
    _check_conv(crown, weight, 3, stride)
    return convolve_crown(crown, weight, bias, stride)


def convolve_crown(
    crown: Crown | Tensor, weight: Tensor, bias: Tensor | None, stride: int, relu: bool = False
) -> Crown:
    """Convolve both kinds of rectangles, each with its arrangement of the taps, and rectify them if asked for.

    Accepts vertex values as well: operators in C++ read them without building the crown.
    """
    if isinstance(crown, Tensor):
        return Crown(*convolve_vertices(crown, weight, bias, stride, relu))
    return Crown(*convolve_rectangles(*crown, weight, bias, stride, relu))


class CrownConv2d(HexagonWeights):
    """Hexagonal convolution on a crown with weight ``(out, in, 7)``; see ``crown_conv2d``.

    Args:
        in_channels: channels of the crown given.
        out_channels: channels of the crown returned.
        stride: 1, or 2 to keep the vertices of the next coarser level.
        bias: whether to add a learned bias.
        kernel_size: is refused: a kernel is a vertex and its neighbours.

    Examples:
        >>> CrownConv2d(3, 32, stride=2)
        CrownConv2d(3, 32, stride=2, bias=False)
    """

    taps = 7

    def forward(self, crown: Crown) -> Crown:
        return crown_conv2d(crown, self.weight, self.bias, self.stride)


class CrownConv3d(HexagonWeights):
    """Hexagonal convolution on a crown of volumes with weight ``(out, in, 21)``; see ``crown_conv3d``.

    Arguments are those of ``CrownConv2d``; hypotheses are always kept.

    Examples:
        >>> CrownConv3d(64, 32)
        CrownConv3d(64, 32, stride=1, bias=False)
    """

    taps = 21

    def forward(self, crown: Crown) -> Crown:
        return crown_conv3d(crown, self.weight, self.bias, self.stride)
