# SPDX-License-Identifier: Apache-2.0
"""The parts of OmniMVS: features of fisheye images, their sweep, and the encoder and decoder of the cost volume.

Convolutions over spheres and volumes of panoramas may continue across the left and right edges.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from sphericalvision.core import check_choice
from sphericalvision.crown.recompute import RecomputedModule
from sphericalvision.sweep import PanoramaSweep
from sphericalvision.sweep.panorama_sweep import PanoramaTables

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
    """A convolution of images and its normalisation, or a bias without ``norm``."""

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


class DilatedBlock(nn.Module):
    """Two normalised 3 x 3 convolutions with a ReLU between them, added to the input, and a ReLU.

    References:
        He et al. (2016), "Deep residual learning for image recognition".
    """

    def __init__(self, channels: int, dilation: int, norm: str) -> None:
        super().__init__()
        self.first = ImageConv(channels, channels, dilation=dilation, norm=norm)
        self.second = ImageConv(channels, channels, dilation=dilation, norm=norm)

    def forward(self, features: Tensor) -> Tensor:
        return F.relu(self.second(F.relu(self.first(features))) + features)


class FisheyeFeatures(RecomputedModule):
    """Map images ``(B, in_channels, H, W)`` to features ``(B, channels, ceil(H / 2), ceil(W / 2))``.

    Feature pixel (i, j) is centred at image pixel (2 i, 2 j). Five residual blocks and three more with dilations 2, 3
    and 4 follow a 5 x 5 convolution with stride 2; the last convolution has neither normalisation nor ReLU.

    Args:
        channels: of the features.
        in_channels: of the images.
        norm: "batch" or "instance".

    References:
        Won, Ryu and Lim (2019), "OmniMVS: end-to-end learning for omnidirectional stereo matching", table 1.

    Examples:
        >>> import torch
        >>> FisheyeFeatures(channels=4)(torch.zeros(1, 1, 20, 31)).shape
        torch.Size([1, 4, 10, 16])
    """

    DILATIONS = (1, 1, 1, 1, 1, 2, 3, 4)

    def __init__(self, channels: int = 32, in_channels: int = 1, norm: str = "batch") -> None:
        super().__init__()
        self.entry = ImageConv(in_channels, channels, 5, 2, norm=norm)
        self.blocks = nn.Sequential(*(DilatedBlock(channels, dilation, norm) for dilation in self.DILATIONS))
        self.last = ImageConv(channels, channels, norm=None)

    def forward(self, images: Float[Tensor, "B C_in H W"]) -> Float[Tensor, "B C h_f w_f"]:
        return self.last(self.blocks(F.relu(self.entry(images))))  # type: ignore[no-any-return]


class Transference(RecomputedModule, SphereConv):
    """Sweep features of a camera ``(B, C, h_f, w_f)`` and convolve each sphere to half its size, ``(B, C', D, h, w)``.

    With ``recompute`` the sweep of one camera is in memory at a time.
    """

    def forward(  # type: ignore[override]
        self,
        features: Float[Tensor, "B C h_f w_f"],
        sweep: PanoramaSweep,
        tables: PanoramaTables,
        camera: int,
    ) -> Float[Tensor, "B C_out D h w"]:
        return super().forward(sweep.camera_values(features, tables, camera))


class EncoderConv(RecomputedModule, VolumeConv):
    """A convolution from scale to scale; saves memory in training with ``recompute``."""


class Across(RecomputedModule, nn.Sequential):
    """The convolutions from encoder to decoder; save memory as ``EncoderConv`` does."""


class CostHourglass(nn.Module):
    """Map a volume ``(B, in_channels, D, h, w)`` to a score of each hypothesis and pixel ``(B, 2 D, 2 h, 2 w)``.

    Each scale of the encoder has half the size of the one before. Its first convolution leads to the next scale, and
    two more to the decoder, whose transposed convolutions double the size.

    Args:
        in_channels: of the volume.
        channels: of the first scale; the next ones have twice as many, and the last one four times.
        num_scales: how often the size is halved.
        norm: "batch" or "instance".
        circular: whether columns continue at the other edge, or are padded with zeros as in the paper.

    References:
        Won, Ryu and Lim (2019), "OmniMVS: end-to-end learning for omnidirectional stereo matching", table 1; its
        form is that of Kendall et al. (2017), "End-to-end learning of geometry and context for deep stereo
        regression".

    Examples:
        >>> import torch
        >>> CostHourglass(in_channels=8, channels=4, num_scales=2)(torch.zeros(1, 8, 4, 4, 8)).shape
        torch.Size([1, 8, 8, 16])
    """

    def __init__(
        self,
        in_channels: int = 128,
        channels: int = 64,
        num_scales: int = 4,
        norm: str = "batch",
        circular: bool = False,
    ) -> None:
        super().__init__()
        widths = [channels, *[2 * channels] * (num_scales - 1), 4 * channels]
        self.fusion = EncoderConv(in_channels, channels, norm=norm, circular=circular)
        entries, across, ups = [], [], []
        for scale, width in enumerate(widths):
            before = widths[max(scale - 1, 0)]
            entries.append(EncoderConv(before, width, 1 if scale == 0 else 2, norm, circular))
            across.append(Across(*(VolumeConv(width, width, norm=norm, circular=circular) for _ in range(2))))
            ups.append(VolumeUpConv(width, before, norm, circular) if scale else nn.Identity())
        self.entries, self.across = nn.ModuleList(entries), nn.ModuleList(across)
        self.ups = nn.ModuleList(ups[1:])
        self.score = VolumeUpConv(channels, 1, None, circular)

    def forward(self, volume: Float[Tensor, "B C_in D h w"]) -> Float[Tensor, "B 2*D 2*h 2*w"]:
        volume = self.fusion(volume.contiguous(memory_format=torch.channels_last_3d))
        skips = []
        for entry, across in zip(self.entries, self.across, strict=True):
            volume = entry(volume)
            skips.append(across(volume))
        volume = skips.pop()
        for up in reversed(self.ups):
            skip = skips.pop()
            volume = up(volume, skip.shape[2:]) + skip
        spheres, rows, columns = volume.shape[2:]
        return self.score(volume, (2 * spheres, 2 * rows, 2 * columns)).squeeze(1)  # type: ignore[no-any-return]
