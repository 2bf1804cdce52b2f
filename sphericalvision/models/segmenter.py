# SPDX-License-Identifier: Apache-2.0
"""A small U-Net that says what everything on a sphere is, with four kinds of convolutions and otherwise the same."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from sphericalvision.core import ShapeError
from sphericalvision.crown import (
    Crown,
    CrownAvgPool2d,
    CrownBatchNorm2d,
    CrownConv2d,
    CrownExchange,
    CrownPointwise,
    CrownUpsample,
    FromCrown,
    HexConv2d,
    ToCrown,
)
from sphericalvision.icosphere import IcospherePool, icosphere_upsample
from sphericalvision.models.classifier import WIDTHS, classifier_grid
from sphericalvision.sphere import SphereConv2d

__all__ = ["SphereSegmenter"]


class SphereSegmenter(nn.Module):
    """A U-Net of three levels of detail.

    Args:
        network: ``"crown"``, ``"hex"``, ``"sphere"`` or ``"planar"``, as of ``SphereClassifier``.
        level: of the icosphere, 3 or more; equirectangular images have about as many pixels.
        num_classes: number of logits at each place.
        in_channels: of the values given; 3 for colours.
        width: channels at the finest level, doubled at each of the two coarser ones; chosen such that all four networks
            have about 75,000 parameters when not given.

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
        super().__init__()
        self.grid = classifier_grid(network, level)
        self.network, self.level = network, level
        self.num_classes, self.in_channels = num_classes, in_channels
        self.width = WIDTHS[network] if width is None else width
        w = self.width
        self.fine = self._block(in_channels, w, level)
        self.middle = nn.Sequential(self._pool(level), self._block(w, 2 * w, level - 1))
        self.coarse = nn.Sequential(
            self._pool(level - 1),
            self._block(2 * w, 4 * w, level - 2),
            self._block(4 * w, 4 * w, level - 2),
        )
        self.to_middle = self._block(6 * w, 2 * w, level - 1)
        self.to_fine = self._block(3 * w, w, level)
        self.head = nn.Conv1d(w, num_classes, 1)

    @property
    def hyperparameters(self) -> dict[str, Any]:
        """Plain scalars that rebuild this network: ``SphereSegmenter(**net.hyperparameters)``."""
        names = ("network", "level", "num_classes", "in_channels", "width")
        return {name: getattr(self, name) for name in names}

    def forward(self, values: Float[Tensor, "B C_in *grid"]) -> Float[Tensor, "B classes *grid"]:
        """Return logits ``(B, num_classes, *grid.shape)`` of values ``(B, in_channels, *grid.shape)``."""
        if tuple(values.shape[1:]) != (self.in_channels, *self.grid.shape):
            size = ", ".join(map(str, (self.in_channels, *self.grid.shape)))
            raise ShapeError(f"values: expected shape (B, {size}), got {tuple(values.shape)}")
        fine = self.fine(ToCrown()(values) if self.network == "crown" else values)
        middle = self.middle(fine)
        middle = self.to_middle(_joined(self._upsampled(self.coarse(middle)), middle))
        features = self.to_fine(_joined(self._upsampled(middle), fine))
        if self.network == "crown":
            features = FromCrown()(features)
        return self.head(features.flatten(2)).unflatten(-1, self.grid.shape)  # type: ignore[no-any-return]

    def _block(self, in_channels: int, out_channels: int, level: int) -> nn.Sequential:
        """Return a convolution, a normalisation and a ReLU."""
        if self.network == "crown":
            crown = CrownConv2d(in_channels, out_channels)
            relu = CrownPointwise(nn.ReLU())
            return nn.Sequential(crown, CrownBatchNorm2d(out_channels), relu, CrownExchange())
        if self.network == "hex":
            hexagonal = HexConv2d(in_channels, out_channels, orientation="north", level=level)
            return nn.Sequential(hexagonal, nn.BatchNorm1d(out_channels), nn.ReLU())
        image: nn.Module
        if self.network == "sphere":
            image = SphereConv2d(in_channels, out_channels, bias=False)
        else:
            image = nn.Conv2d(in_channels, out_channels, 3, padding=1, bias=False)
        return nn.Sequential(image, nn.BatchNorm2d(out_channels), nn.ReLU())

    def _pool(self, level: int) -> nn.Module:
        """Return the step to half the resolution."""
        if self.network == "crown":
            return CrownAvgPool2d()
        return IcospherePool(level) if self.network == "hex" else nn.AvgPool2d(2)

    def _upsampled(self, values: Any) -> Any:
        """Values at twice the resolution."""
        if self.network == "crown":
            return CrownUpsample()(values)
        return icosphere_upsample(values) if self.network == "hex" else F.interpolate(values, scale_factor=2)


def _joined(one: Any, other: Any) -> Any:
    """Channels of both."""
    if isinstance(one, Crown):
        return Crown(*(torch.cat(pair, 2) for pair in zip(one, other, strict=True)))
    return torch.cat((one, other), 1)
