# SPDX-License-Identifier: Apache-2.0
"""Layers of several steps: a convolution and its normalisation, and two of these from vertices to vertices."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sphericalvision.core import ShapeError, check_dtype
from sphericalvision.crown.conv import CrownConv2d, CrownConv3d, convolve_crown
from sphericalvision.crown.fast import normalize_and_convolve
from sphericalvision.crown.layout import Crown, check_crown, from_crown, to_crown
from sphericalvision.crown.norm import _CrownBatchNorm, crown_norm
from sphericalvision.crown.recompute import RecomputedModule
from sphericalvision.kernels import Operator
from sphericalvision.shapes import check_shapes


class _CrownConvNorm(nn.Module):
    """A crown convolution, the normalisation after it and, if asked for, a ReLU."""

    def __init__(self, conv: CrownConv2d | CrownConv3d, norm: _CrownBatchNorm, relu: bool) -> None:
        super().__init__()
        self.conv, self.norm, self.relu = conv, norm, relu

    def forward(self, crown: Crown) -> Crown:
        check_crown(crown)
        check_dtype("crown", crown.col, self.conv.weight)
        return _convolve_and_normalize(crown, self)


def _conv_then_norm(crown: Crown, layer: _CrownConvNorm) -> Crown:
    return layer.norm.normalize(layer.conv(crown), layer.relu)


def _folded_conv(crown: Crown, layer: _CrownConvNorm) -> Crown:
    """One step in place of two, where the normalisation is a product and a sum."""
    if not layer.norm.is_affine:
        return NotImplemented
    weight, bias = layer.norm.folded(layer.conv.weight)
    return convolve_crown(crown, weight, bias, layer.conv.stride, layer.relu)


_convolve_and_normalize = Operator(_conv_then_norm, cpu=_folded_conv, fused=_folded_conv)


class CrownConvNorm2d(_CrownConvNorm):
    """A crown convolution, the normalisation after it and, if asked for, a ReLU.

    Args:
        in_channels: channels of the crown given.
        out_channels: channels of the crown returned.
        stride: 1, or 2 to keep the vertices of the next coarser level.
        norm: ``"batch"`` or ``"instance"``.
        relu: whether a ReLU follows.

    Examples:
        >>> import torch
        >>> CrownConvNorm2d(3, 8, stride=2, relu=True)(to_crown(torch.rand(1, 3, 162))).col.shape
        torch.Size([1, 5, 8, 5, 3])
    """

    def __init__(
        self, in_channels: int, out_channels: int, stride: int = 1, norm: str = "batch", relu: bool = False
    ) -> None:
        conv = CrownConv2d(in_channels, out_channels, stride)
        super().__init__(conv, crown_norm(norm, 2, out_channels), relu)


class CrownConvNorm3d(_CrownConvNorm):
    """The same for crowns of volumes, at stride 1; see ``CrownConvNorm2d``.

    Examples:
        >>> import torch
        >>> CrownConvNorm3d(3, 8)(to_crown(torch.rand(1, 3, 4, 42))).row.shape
        torch.Size([1, 5, 8, 4, 3, 5])
    """

    def __init__(self, in_channels: int, out_channels: int, norm: str = "batch", relu: bool = False) -> None:
        conv = CrownConv3d(in_channels, out_channels)
        super().__init__(conv, crown_norm(norm, 3, out_channels), relu)


Layer = _CrownConvNorm | CrownConv2d | CrownConv3d


def convolve_twice(given: Crown | Tensor, first: _CrownConvNorm, second: Layer) -> Crown:
    """Apply two layers, the first with a ReLU, to a crown, or to that of values at vertices ``(B, C, [N,] V)``.

    The same as ``second(first(crown))``. Where operators are in use, neither the crown of values nor, while there are
    statistics to take, the normalised crown between the layers is written, or kept for the backward pass.
    """
    check_dtype("crown", given if isinstance(given, Tensor) else given.col, first.conv.weight)
    return _convolve_twice(given, first, second)


def _one_after_the_other(given: Crown | Tensor, first: _CrownConvNorm, second: Layer) -> Crown:
    return second(first(to_crown(given) if isinstance(given, Tensor) else given))  # type: ignore[no-any-return]


def _without_what_lies_between(given: Crown | Tensor, first: _CrownConvNorm, second: Layer) -> Crown:
    conv, norm = first.conv, first.norm
    after = second.conv if isinstance(second, _CrownConvNorm) else second
    if not first.relu or after.stride != 1 or after.weight.shape[1] != conv.weight.shape[0]:
        return NotImplemented
    if norm.is_affine:
        weight, bias = norm.folded(conv.weight)
        return second(convolve_crown(given, weight, bias, conv.stride, relu=True))  # type: ignore[no-any-return]
    between = convolve_crown(given, conv.weight, conv.bias, conv.stride)
    crown = Crown(*normalize_and_convolve(*between, norm, True, after.weight, after.bias))
    return second.norm.normalize(crown, second.relu) if isinstance(second, _CrownConvNorm) else crown


_convolve_twice = Operator(
    _one_after_the_other, cpu=_without_what_lies_between, fused=_without_what_lies_between
)


@check_shapes
def crown_block3d(
    volume: Float[Tensor, "B C_in N V"],
    first: CrownConvNorm3d,
    second: CrownConvNorm3d | CrownConv3d,
    residual: bool = False,
) -> Float[Tensor, "B C_out N V"]:
    """Apply two layers to the crown of a volume on vertices, and return to vertices.

    Returning takes the mean over both directions of the crown, which so exchange what they know.

    Args:
        volume: ``(B, in, N, V)``.
        first: from in to hidden channels, with a ReLU.
        second: from hidden to out channels, without one.
        residual: whether to add the volume to the result.

    Returns:
        ``(B, out, N, V)``.

    Raises:
        ShapeError: if volume and layers do not fit.

    Examples:
        >>> import torch
        >>> layers = CrownConvNorm3d(2, 4, relu=True), CrownConv3d(4, 1)
        >>> crown_block3d(torch.rand(1, 2, 8, 42), *layers).shape
        torch.Size([1, 1, 8, 42])
    """
    channels = first.conv.weight.shape[1]
    check_dtype("volume", volume, first.conv.weight)
    if volume.shape[1] != channels:
        raise ShapeError(f"volume: expected {channels} channels (dimension 1), got {volume.shape[1]}")
    change = from_crown(convolve_twice(volume, first, second))
    if not residual:
        return change
    return volume + change if torch.is_grad_enabled() else change.add_(volume)


class CrownBlock3d(RecomputedModule):
    """Two normalised 3D crown convolutions with a ReLU between them, from vertices to vertices.

    Args:
        in_channels: of the volume.
        hidden_channels: between the convolutions.
        out_channels: of the result.
        norm: ``"batch"`` or ``"instance"``.
        residual: whether the volume is added to the result.

    References:
        Komatsu et al. (2020), "360° depth estimation from multiple fisheye images with origami crown
        representation of icosahedron", table of layers.

    Examples:
        >>> import torch
        >>> CrownBlock3d(3, 4, 5)(torch.rand(1, 3, 8, 42)).shape
        torch.Size([1, 5, 8, 42])
    """

    def __init__(
        self,
        in_channels: int,
        hidden_channels: int,
        out_channels: int,
        norm: str = "batch",
        residual: bool = False,
    ) -> None:
        super().__init__()
        self.first = CrownConvNorm3d(in_channels, hidden_channels, norm, relu=True)
        self.second = CrownConvNorm3d(hidden_channels, out_channels, norm)
        self.residual = residual

    def forward(self, volume: Float[Tensor, "B C_in N V"]) -> Float[Tensor, "B C_out N V"]:
        return crown_block3d(volume, self.first, self.second, self.residual)
