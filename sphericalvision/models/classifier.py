# SPDX-License-Identifier: Apache-2.0
"""A small classifier on the sphere, with one of five kinds of convolutions."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sphericalvision.crown import FromCrown, ToCrown
from sphericalvision.icosphere import Icosphere
from sphericalvision.models.sphere_blocks import SphereNetwork, convolution_block, pooling
from sphericalvision.sphere import Equirectangular


class SphereClassifier(SphereNetwork):
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
        super().__init__(network, level, num_classes, in_channels, width)
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

    def forward(self, values: Float[Tensor, "B C_in *grid"]) -> Float[Tensor, "B classes"]:
        """Return logits ``(B, num_classes)`` of values ``(B, in_channels, *grid.shape)``."""
        self.check_values(values)
        features = self.features(values)
        features = features.amax(2) if self.network == "hexgroup" else features.flatten(2)
        return self.head(features @ self.share)

    def _shares(self) -> Tensor:
        """Return the weight of each point in the mean after the convolutions, ``(n,)``."""
        if isinstance(self.grid, Icosphere):
            areas = Icosphere(self.level - 2).solid_angles
        else:
            coarse = Equirectangular(self.grid.height // 4, self.grid.width // 4)
            areas = coarse.solid_angles.flatten() if self.network == "sphere" else torch.ones(coarse.shape)
        return areas.flatten() / areas.sum()
