# SPDX-License-Identifier: Apache-2.0
"""A small classifier of what lies on a sphere, with five kinds of convolutions and otherwise the same."""

from __future__ import annotations

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sphericalvision.core import ArgumentError, ShapeError, check_choice
from sphericalvision.crown import (
    CrownAvgPool2d,
    CrownBatchNorm2d,
    CrownConv2d,
    CrownExchange,
    CrownPointwise,
    FromCrown,
    HexConv2d,
    HexGroupConv2d,
    HexLiftConv2d,
    ToCrown,
)
from sphericalvision.icosphere import Icosphere, IcospherePool, num_icosphere_vertices
from sphericalvision.sphere import Equirectangular, SphereConv2d

__all__ = ["CLASSIFIER_NETWORKS", "SphereClassifier", "classifier_grid"]

CLASSIFIER_NETWORKS = ("crown", "hex", "hexgroup", "sphere", "planar")

WIDTHS = {"crown": 16, "hex": 16, "hexgroup": 4, "sphere": 14, "planar": 14}
"""Channels of the first layer; kernels of seven and of nine taps then have equally many parameters within 2 %. In six
orientations four channels are 24, and the parameters three eighths of the others'."""


def classifier_grid(network: str, level: int) -> Icosphere | Equirectangular:
    """Return the grid that a network of ``SphereClassifier`` works on.

    ``"crown"``, ``"hex"`` and ``"hexgroup"`` take the icosphere of the level; ``"sphere"`` and ``"planar"`` an
    equirectangular image with about as many pixels, whose height divides by four.

    Raises:
        ArgumentError: if the network is unknown or the level below 3.

    Examples:
        >>> classifier_grid("planar", level=4), classifier_grid("hex", level=4)
        (Equirectangular(height=36, width=72), Icosphere(level=4, vertices=2562, faces=5120))
    """
    check_choice("network", network, CLASSIFIER_NETWORKS)
    if level < 3:
        raise ArgumentError(f"level: expected 3 or more, as the network halves twice, got {level}")
    if network in ("crown", "hex", "hexgroup"):
        return Icosphere(level)
    height = 4 * round(math.sqrt(num_icosphere_vertices(level) / 2) / 4)
    return Equirectangular(height, 2 * height)


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
        self.grid = classifier_grid(network, level)
        self.network, self.level = network, level
        self.num_classes, self.in_channels = num_classes, in_channels
        self.width = WIDTHS[network] if width is None else width
        w = self.width
        layers = [
            *(self._block(in_channels, w, level), self._pool(level)),
            *(self._block(w, 2 * w, level - 1), self._pool(level - 1)),
            *(self._block(2 * w, 4 * w, level - 2), self._block(4 * w, 4 * w, level - 2)),
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

    def _block(self, in_channels: int, out_channels: int, level: int) -> nn.Sequential:
        """Return a convolution, a normalisation and a ReLU."""
        if self.network == "crown":
            crown = CrownConv2d(in_channels, out_channels)
            relu = CrownPointwise(nn.ReLU())
            return nn.Sequential(crown, CrownBatchNorm2d(out_channels), relu, CrownExchange())
        if self.network == "hex":
            hexagonal = HexConv2d(in_channels, out_channels, orientation="north", level=level)
            return nn.Sequential(hexagonal, nn.BatchNorm1d(out_channels), nn.ReLU())
        if self.network == "hexgroup":
            kind = HexLiftConv2d if level == self.level else HexGroupConv2d
            return nn.Sequential(
                kind(in_channels, out_channels, level), nn.BatchNorm2d(out_channels), nn.ReLU()
            )
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
        return IcospherePool(level) if isinstance(self.grid, Icosphere) else nn.AvgPool2d(2)

    def _shares(self) -> Tensor:
        """Return each place's share in the mean after the convolutions, ``(n,)``."""
        if isinstance(self.grid, Icosphere):
            areas = Icosphere(self.level - 2).solid_angles
        else:
            coarse = Equirectangular(self.grid.height // 4, self.grid.width // 4)
            areas = coarse.solid_angles.flatten() if self.network == "sphere" else torch.ones(coarse.shape)
        return areas.flatten() / areas.sum()
