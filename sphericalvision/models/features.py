# SPDX-License-Identifier: Apache-2.0
"""Features of an image on the icosphere: crown convolutions and residual blocks, one or two levels coarser."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from sphericalvision.core import ArgumentError
from sphericalvision.crown import (
    Crown,
    CrownAvgPool2d,
    CrownConv2d,
    CrownConvNorm2d,
    crown_upsample,
    exchange,
    from_crown,
    to_crown,
)
from sphericalvision.crown.block import convolve_twice
from sphericalvision.crown.layout import crown_map
from sphericalvision.crown.recompute import RecomputedModule

__all__ = ["FeatureExtractor", "ResidualBlock", "camera_by_camera"]


class ResidualBlock(nn.Module):
    """Two normalised convolutions with a ReLU between them, added to the input, and a ReLU.

    With ``stride=2`` the first convolution goes to the next coarser level, and the input joins it through a 3
    x 3 mean.

    References:
        He et al. (2016), "Deep residual learning for image recognition".
    """

    def __init__(self, channels: int, stride: int = 1, norm: str = "batch") -> None:
        super().__init__()
        self.first = CrownConvNorm2d(channels, channels, stride, norm, relu=True)
        self.second = CrownConvNorm2d(channels, channels, norm=norm)
        self.shortcut = CrownAvgPool2d(stride) if stride > 1 else nn.Identity()

    def forward(self, crown: Crown) -> Crown:
        total = convolve_twice(crown, self.first, self.second) + self.shortcut(crown)
        return crown_map(torch.relu_, total)  # a sum, which nobody else has


class FeatureExtractor(RecomputedModule):
    """Map an image on the icosphere ``(B, in_channels, V_level)`` to features ``(B, channels, V_{level-coarsening})``.

    The weights do not depend on the level; the directions of each crown exchange what they know at every
    change of level.

    Args:
        channels: of the features.
        in_channels: of the images.
        norm: "batch" or "instance".
        coarsening: levels by which the features are coarser than the image: 2, as in the paper, or 1: then what
            the coarser half of the network found is added to what the finer one found, at the finer level.

    References:
        Komatsu et al. (2020), "360° depth estimation from multiple fisheye images with origami crown
        representation of icosahedron", table of layers; Lin et al. (2017), "Feature pyramid networks for
        object detection", for the sum of levels.

    Examples:
        >>> import torch
        >>> FeatureExtractor(channels=4)(torch.zeros(1, 3, 642)).shape  # level 3 to level 1
        torch.Size([1, 4, 42])
    """

    def __init__(
        self, channels: int = 32, in_channels: int = 3, norm: str = "batch", coarsening: int = 2
    ) -> None:
        super().__init__()
        if coarsening not in (1, 2):
            raise ArgumentError(f"coarsening: expected 1 or 2 levels, got {coarsening!r}")
        self.coarsening = coarsening
        self.entry = CrownConvNorm2d(in_channels, channels, 2, norm, relu=True)
        self.second = CrownConvNorm2d(channels, channels, norm=norm, relu=True)
        self.fine = nn.Sequential(*(ResidualBlock(channels, norm=norm) for _ in range(3)))
        self.coarse = nn.Sequential(
            ResidualBlock(channels, 2, norm), *(ResidualBlock(channels, norm=norm) for _ in range(4))
        )
        self.last = CrownConv2d(channels, channels)

    def forward(self, images: Float[Tensor, "B C_in V_image"]) -> Float[Tensor, "B C V"]:
        crown = exchange(convolve_twice(to_crown(images), self.entry, self.second))
        fine = exchange(self.fine(crown))
        crown = exchange(self.coarse(fine))
        if self.coarsening == 1:
            crown = crown_upsample(crown) + fine
        return from_crown(self.last(crown))


def camera_by_camera(
    extractor: nn.Module, images: Float[Tensor, "B n 3 *size"]
) -> Float[Tensor, "B n C *size_of_features"]:
    """Return the features ``(B, n, C, *)`` of the images ``(B, n, 3, *)`` of n cameras.

    Statistics of the batch, which batch normalisation takes in training, are those of one camera at a time, and running
    statistics take one step a camera. Everything else sees no difference, and gets all cameras in one batch.

    References:
        Komatsu et al. (2020), "360° depth estimation from multiple fisheye images with origami crown
        representation of icosahedron", whose features are extracted so.

    Examples:
        >>> camera_by_camera(nn.Conv1d(3, 5, 1), torch.zeros(2, 4, 3, 42)).shape
        torch.Size([2, 4, 5, 42])
    """
    if any(map(_takes_statistics_of_the_batch, extractor.modules())):
        return torch.stack([extractor(camera) for camera in images.unbind(1)], 1)
    return extractor(images.flatten(0, 1)).unflatten(0, images.shape[:2])  # type: ignore[no-any-return]


def _takes_statistics_of_the_batch(part: nn.Module) -> bool:
    """Instance normalisation is of the same class, but keeps no running statistics."""
    return isinstance(part, _BatchNorm) and part.training and part.running_mean is not None
