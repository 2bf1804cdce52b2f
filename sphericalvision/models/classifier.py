# SPDX-License-Identifier: Apache-2.0
"""A small classifier of what lies on a sphere, with five kinds of convolutions and otherwise the same."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sphericalvision.core import ShapeError
from sphericalvision.crown import FromCrown, ToCrown
from sphericalvision.icosphere import Icosphere
from sphericalvision.models.sphere_blocks import WIDTHS, convolution_block, network_grid, pooling
from sphericalvision.sphere import Equirectangular

__all__ = ["SphereClassifier"]


class SphereClassifier(nn.Module):
    """Four convolutions on three levels of detail, the mean over the sphere, and a linear layer.

    Args:
        network: ``"crown"`` (``CrownConv2d``, both directions), ``"hex"`` (``HexConv2d``, true neighbours, aligned with
            north), ``"hexgroup"`` (the same in six orientations, ``HexGroupConv2d``, of which the mean takes the
            largest), ``"sphere"`` (``SphereConv2d`` on an equirectangular image), or ``"planar"`` (``nn.Conv2d`` with
            zero padding on the same image, and a mean over pixels: it knows of no sphere).
        level: of the icosphere, 3 or more; the equirectangular image has about as many pixels.
        num_classes: number of logits.
        in_channels: of the values given.
        width: channels of the first layer, doubled at each of the two coarser levels; chosen such that all
            networks have about 47,000 parameters when not given, but for ``"hexgroup"``, which has 18,000.

    Raises:
        ArgumentError: if the network is unknown or the level below 3.

    References:
        Cohen et al. (2018), "Spherical CNNs", for the task; Coors et al. (2018), "SphereNet", Hoogeboom et al.
        (2018), "HexaConv", and Zhang et al. (2019), "Orientation-aware semantic segmentation on icosahedron spheres",
        for the convolutions.

    Examples:
        >>> net = SphereClassifier("hex", level=3)
        >>> net(torch.rand(2, 1, 642)).shape
        torch.Size([2, 10])
        >>> net.grid
        Icosphere(level=3, vertices=642, faces=1280)
    """

    share: Float[Tensor, " V"]

    def __init__(
        self,
        network: str = "hex",
        level: int = 4,
        num_classes: int = 10,
        in_channels: int = 1,
        width: int | None = None,
    ) -> None:
        super().__init__()
        self.grid = network_grid(network, level)
        self.network, self.level = network, level
        self.num_classes, self.in_channels = num_classes, in_channels
        self.width = WIDTHS[network] if width is None else width
        w = self.width
        layers = [
            convolution_block(network, in_channels, w, level, first=True),
            pooling(network, level),
            convolution_block(network, w, 2 * w, level - 1),
            pooling(network, level - 1),
            convolution_block(network, 2 * w, 4 * w, level - 2),
            convolution_block(network, 4 * w, 4 * w, level - 2),
        ]
        if network == "crown":
            layers = [ToCrown(), *layers, FromCrown()]
        self.features = nn.Sequential(*layers)
        self.head = nn.Linear(4 * w, num_classes)
        self.register_buffer("share", self._shares(), persistent=False)

    @property
    def hyperparameters(self) -> dict[str, Any]:
        """Plain scalars that rebuild this network: ``SphereClassifier(**net.hyperparameters)``."""
        names = ("network", "level", "num_classes", "in_channels", "width")
        return {name: getattr(self, name) for name in names}

    def forward(self, values: Float[Tensor, "B C_in *grid"]) -> Float[Tensor, "B classes"]:
        """Return logits ``(B, num_classes)`` of values ``(B, in_channels, *grid.shape)``."""
        if tuple(values.shape[1:]) != (self.in_channels, *self.grid.shape):
            size = ", ".join(map(str, (self.in_channels, *self.grid.shape)))
            raise ShapeError(f"values: expected shape (B, {size}), got {tuple(values.shape)}")
        features = self.features(values)
        features = features.amax(2) if self.network == "hexgroup" else features.flatten(2)
        return self.head(features @ self.share)

    def _shares(self) -> Tensor:
        """Return each place's share in the mean after the convolutions, ``(n,)``."""
        if isinstance(self.grid, Icosphere):
            areas = Icosphere(self.level - 2).solid_angles
        else:
            coarse = Equirectangular(self.grid.height // 4, self.grid.width // 4)
            areas = coarse.solid_angles.flatten() if self.network == "sphere" else torch.ones(coarse.shape)
        return areas.flatten() / areas.sum()
