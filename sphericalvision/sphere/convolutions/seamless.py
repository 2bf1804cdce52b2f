# SPDX-License-Identifier: Apache-2.0
"""Planar networks made seam-free: the padding of their layers is replaced, their weights are not."""

from __future__ import annotations

from collections.abc import Callable

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from sphericalvision.core import ArgumentError, check_type
from sphericalvision.sphere.convolutions.padding import EquirectangularPad2d
from sphericalvision.sphere.convolutions.sphere_conv import SphereConv2d, along_both

# Layers that look across the border in ways that padding before them does not mend.
UNSUPPORTED = (nn.ConvTranspose2d, nn.Fold, nn.Unfold, nn.FractionalMaxPool2d)


class PaddedConv2d(nn.Module):
    """A planar convolution, of the same parameters and names, with the module ``pad`` in place of its padding.

    Examples:
        >>> layer = PaddedConv2d(nn.Conv2d(3, 8, 3), EquirectangularPad2d(1))
        >>> list(layer.state_dict())
        ['weight', 'bias']
    """

    def __init__(self, convolution: nn.Conv2d, pad: nn.Module) -> None:
        super().__init__()
        self.pad = pad
        self.weight, self.bias = convolution.weight, convolution.bias
        self.stride, self.dilation, self.groups = convolution.stride, convolution.dilation, convolution.groups

    def forward(self, images: Float[Tensor, "B C_in *size"]) -> Float[Tensor, "B C_out *size_out"]:
        return F.conv2d(self.pad(images), self.weight, self.bias, self.stride, 0, self.dilation, self.groups)

    def extra_repr(self) -> str:
        out_channels, in_channels, *kernel_size = self.weight.shape
        return f"{in_channels * self.groups}, {out_channels}, kernel_size={tuple(kernel_size)}, stride={self.stride}"


def make_seamless(
    module: nn.Module, pad: Callable[[tuple[int, int, int, int]], nn.Module] = EquirectangularPad2d
) -> nn.Module:
    """Replace the padding of every 2D convolution and pooling in a planar network.

    The network is changed in place, as by ``torch.nn.SyncBatchNorm.convert_sync_batchnorm``; its parameters stay the
    same tensors under the same names, so weights load before and after. Separate padding modules (``nn.ZeroPad2d``
    and so on) are replaced, too.

    Args:
        module: planar network.
        pad: makes a module from (left, right, top, bottom): ``EquirectangularPad2d`` for panoramas, ``CubePad2d`` for
            cube maps with their faces in the batch.

    Returns:
        The module, or what replaces it if it is a single layer.

    Raises:
        ArgumentError: if the network has a layer whose borders cannot be mended so, such as ``nn.ConvTranspose2d``.

    Examples:
        >>> network = make_seamless(nn.Sequential(nn.Conv2d(3, 8, 3, padding=1), nn.ReLU()))
        >>> list(network.state_dict())
        ['0.weight', '0.bias']
    """
    check_type("module", module, nn.Module)
    for name, layer in module.named_modules():
        interpolates = isinstance(layer, nn.Upsample) and layer.mode != "nearest"
        if isinstance(layer, UNSUPPORTED) or interpolates:
            raise ArgumentError(
                f"module: {name or 'the module'} is {layer}, whose borders padding cannot mend; "
                "use nn.Upsample(mode='nearest') and a convolution in its place"
            )
    return _replaced(module, pad)


def _replaced(module: nn.Module, pad: Callable[[tuple[int, int, int, int]], nn.Module]) -> nn.Module:
    if isinstance(module, SphereConv2d):
        return module
    if isinstance(module, nn.Conv2d):
        sides = _sides(module._reversed_padding_repeated_twice)
        return PaddedConv2d(module, pad(sides)) if any(sides) else module
    if isinstance(module, nn.MaxPool2d | nn.AvgPool2d):
        vertical, horizontal = along_both(module.padding)
        if not (vertical or horizontal):
            return module
        module.padding = 0
        return nn.Sequential(pad((horizontal, horizontal, vertical, vertical)), module)
    if isinstance(module, nn.ZeroPad2d | nn.ReflectionPad2d | nn.ReplicationPad2d | nn.CircularPad2d):
        return pad(_sides(module.padding))
    for name, child in module.named_children():
        setattr(module, name, _replaced(child, pad))
    return module


def _sides(padding: list[int] | tuple[int, ...]) -> tuple[int, int, int, int]:
    left, right, top, bottom = padding
    return left, right, top, bottom
