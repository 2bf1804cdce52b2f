# SPDX-License-Identifier: Apache-2.0
"""A small U-Net for segmentation on the sphere, with one of five kinds of convolutions."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from sphericalvision.crown import Crown, CrownUpsample, FromCrown, ToCrown
from sphericalvision.icosphere import Icosphere, icosphere_upsample
from sphericalvision.models.sphere_blocks import SphereNetwork, convolution_block, pooling


class SphereSegmenter(SphereNetwork):
    """A U-Net of three levels of detail.

    Args:
        network: ``"crown"``, ``"hex"``, ``"hexgroup"``, ``"sphere"`` or ``"planar"``, as of ``SphereClassifier``.
        level: of the icosphere, 3 or more; equirectangular images have about as many pixels.
        num_classes: number of logits at each point.
        in_channels: of the values given; 3 for colours.
        width: channels at the finest level, doubled at each of the two coarser ones; chosen such that all networks have
            about 74,000 parameters when not given, but for ``"hexgroup"``, which has 28,000.

    Raises:
        ArgumentError: if the network is unknown or the level below 3.

    References:
        Ronneberger et al. (2015), "U-Net"; Zhang et al. (2019), "Orientation-aware semantic segmentation on
        icosahedron spheres", for the task.

    Examples:
        >>> net = SphereSegmenter("crown", level=3, num_classes=5)
        >>> net(torch.rand(2, 3, 642)).shape
        torch.Size([2, 5, 642])
    """

    def __init__(
        self,
        network: str = "hex",
        level: int = 4,
        num_classes: int = 13,
        in_channels: int = 3,
        width: int | None = None,
    ) -> None:
        super().__init__(network, level, num_classes, in_channels, width)
        w = self.width
        self.fine = convolution_block(network, in_channels, w, level, first=True)
        self.middle = nn.Sequential(pooling(network, level), convolution_block(network, w, 2 * w, level - 1))
        self.coarse = nn.Sequential(
            pooling(network, level - 1),
            convolution_block(network, 2 * w, 4 * w, level - 2),
            convolution_block(network, 4 * w, 4 * w, level - 2),
        )
        self.to_middle = convolution_block(network, 6 * w, 2 * w, level - 1)
        self.to_fine = convolution_block(network, 3 * w, w, level)
        self.head = nn.Conv1d(w, num_classes, 1)

    def forward(self, values: Float[Tensor, "B C_in *grid"]) -> Float[Tensor, "B classes *grid"]:
        """Return logits ``(B, num_classes, *grid.shape)`` of values ``(B, in_channels, *grid.shape)``."""
        self.check_values(values)
        fine = self.fine(ToCrown()(values) if self.network == "crown" else values)
        medium = self.middle(fine)
        medium = self.to_middle(_joined(self._upsampled(self.coarse(medium)), medium))
        features = self.to_fine(_joined(self._upsampled(medium), fine))
        if self.network == "crown":
            features = FromCrown()(features)
        elif self.network == "hexgroup":
            features = features.amax(2)  # over orientations
        return self.head(features.flatten(2)).unflatten(-1, self.grid.shape)  # type: ignore[no-any-return]

    def _upsampled(self, values: Any) -> Any:
        """Values at twice the resolution."""
        if self.network == "crown":
            return CrownUpsample()(values)
        on_icosphere = isinstance(self.grid, Icosphere)
        return icosphere_upsample(values) if on_icosphere else F.interpolate(values, scale_factor=2)


def _joined(one: Any, other: Any) -> Any:
    """Channels of both."""
    if isinstance(one, Crown):
        return Crown(*(torch.cat(pair, 2) for pair in zip(one, other, strict=True)))
    return torch.cat((one, other), 1)
