# SPDX-License-Identifier: Apache-2.0
"""Convolutions over images, spheres and volumes of panoramas, which may continue across the left and right edges."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from sphericalvision.core import check_choice

__all__ = ["NORMS", "ImageConv", "SphereConv", "VolumeConv", "VolumeUpConv", "norm_layer"]

NORMS = ("batch", "instance")
"""Normalisations: by the statistics of the batch, or of each sample alone."""


def norm_layer(norm: str, channels: int, dims: int) -> nn.Module:
    """Return the normalisation of ``channels`` channels over ``dims`` dimensions, with scale and offset.

    Examples:
        >>> norm_layer("instance", 8, 3)(torch.ones(1, 8, 2, 4, 4)).shape
        torch.Size([1, 8, 2, 4, 4])
    """
    check_choice("norm", norm, NORMS)
    if norm == "instance":
        return nn.GroupNorm(channels, channels)  # the same numbers, without copies of channels-last memory
    return nn.BatchNorm2d(channels) if dims == 2 else nn.BatchNorm3d(channels)


class ImageConv(nn.Sequential):
    """A convolution of images and its normalisation; without ``norm`` it stands alone and has a bias."""

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        kernel_size: int = 3,
        stride: int = 1,
        dilation: int = 1,
        norm: str | None = "batch",
    ) -> None:
        padding = dilation * (kernel_size - 1) // 2  # pixel i of the result is centred at pixel stride * i
        conv = nn.Conv2d(in_channels, out_channels, kernel_size, stride, padding, dilation, bias=norm is None)
        super().__init__(conv, *(() if norm is None else (norm_layer(norm, out_channels, 2),)))


class SphereConv(nn.Conv3d):
    """A 3 x 3 convolution with stride 2 of each sphere on its own, from ``(B, C, D, h, w)`` to half as many pixels.

    Pixel (2 i, 2 j) of a sphere is the centre of pixel (i, j) of the result. With ``circular`` columns continue at
    the other edge; rows are padded with zeros.
    """

    def __init__(self, in_channels: int, out_channels: int, circular: bool = False) -> None:
        super().__init__(
            in_channels, out_channels, (1, 3, 3), (1, 2, 2), (0, 1, 0 if circular else 1), bias=False
        )
        self.circular = circular

    def forward(self, volume: Float[Tensor, "B C_in D h w"]) -> Float[Tensor, "B C_out D h_out w_out"]:
        return super().forward(wrap_columns(volume) if self.circular else volume)


class VolumeConv(nn.Module):
    """A 3 x 3 x 3 convolution of a volume ``(B, C, D, h, w)``, its normalisation, and a ReLU.

    With stride 2 every second voxel of each dimension is the centre of one of the result.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        stride: int = 1,
        norm: str = "batch",
        circular: bool = False,
    ) -> None:
        super().__init__()
        padding = (1, 1, 0 if circular else 1)
        self.conv = nn.Conv3d(in_channels, out_channels, 3, stride, padding, bias=False)
        self.norm = norm_layer(norm, out_channels, 3)
        self.circular = circular

    def forward(self, volume: Float[Tensor, "B C_in D h w"]) -> Float[Tensor, "B C_out D_out h_out w_out"]:
        volume = wrap_columns(volume) if self.circular else volume
        return F.relu(self.norm(self.conv(volume)))


class VolumeUpConv(nn.Module):
    """A transposed 3 x 3 x 3 convolution to twice the size, with normalisation and ReLU unless ``norm`` is None.

    Voxel i is the centre of voxel 2 i of the result: the inverse of ``VolumeConv`` with stride 2.
    """

    def __init__(
        self, in_channels: int, out_channels: int, norm: str | None = "batch", circular: bool = False
    ) -> None:
        super().__init__()
        self.conv = nn.ConvTranspose3d(in_channels, out_channels, 3, 2, 1, bias=norm is None)
        self.norm = None if norm is None else norm_layer(norm, out_channels, 3)
        self.circular = circular

    def forward(
        self, volume: Float[Tensor, "B C_in D h w"], size: tuple[int, int, int]
    ) -> Float[Tensor, "B C_out D_out h_out w_out"]:
        """Return ``(B, C, *size)``; each size is twice the volume's or one less."""
        if self.circular:
            # A column more on either side makes two more of the result on the left, which are cut off.
            wide = (*size[:2], size[2] + 4)
            volume = self.conv(wrap_columns(volume), output_size=wide)[..., 2 : 2 + size[2]]
        else:
            volume = self.conv(volume, output_size=size)
        return volume if self.norm is None else F.relu(self.norm(volume))


def wrap_columns(values: Tensor) -> Tensor:
    """Put the last column before the first one and the first one behind the last.

    Examples:
        >>> wrap_columns(torch.tensor([[1, 2, 3]]))
        tensor([[3, 1, 2, 3, 1]])
    """
    return torch.cat((values[..., -1:], values, values[..., :1]), -1)
