# SPDX-License-Identifier: Apache-2.0
"""Blocks of the small networks for tasks on the sphere, with five kinds of convolutions."""

from __future__ import annotations

import math
from typing import Any

from jaxtyping import Float
from torch import Tensor, nn

from sphericalvision.core import ArgumentError, ShapeError, check_choice
from sphericalvision.crown import (
    CrownAvgPool2d,
    CrownBatchNorm2d,
    CrownConv2d,
    CrownExchange,
    CrownPointwise,
    HexConv2d,
    HexGroupConv2d,
    HexLiftConv2d,
)
from sphericalvision.icosphere import Icosphere, IcospherePool, num_icosphere_vertices
from sphericalvision.sphere import Equirectangular, SphereConv2d

SPHERE_NETWORKS = ("crown", "hex", "hexgroup", "sphere", "planar")

WIDTHS = {"crown": 16, "hex": 16, "hexgroup": 4, "sphere": 14, "planar": 14}
"""Channels of the first layer; kernels of seven and of nine taps then have equally many parameters within 2 %. In six
orientations four channels are 24, and the parameters three eighths of the others'."""

_ON_ICOSPHERES = ("crown", "hex", "hexgroup")


def network_grid(network: str, level: int) -> Icosphere | Equirectangular:
    """Return the grid that a network of ``SphereClassifier`` or ``SphereSegmenter`` works on.

    ``"crown"``, ``"hex"`` and ``"hexgroup"`` take the icosphere of the level; ``"sphere"`` and ``"planar"`` an
    equirectangular image with about as many pixels, whose height divides by four.

    Raises:
        ArgumentError: if the network is unknown or the level below 3.

    Examples:
        >>> network_grid("planar", level=4), network_grid("hex", level=4)
        (Equirectangular(height=36, width=72), Icosphere(level=4, vertices=2562, faces=5120))
    """
    check_choice("network", network, SPHERE_NETWORKS)
    if level < 3:
        raise ArgumentError(f"level: expected 3 or more, as the network halves twice, got {level}")
    if network in _ON_ICOSPHERES:
        return Icosphere(level)
    height = 4 * round(math.sqrt(num_icosphere_vertices(level) / 2) / 4)
    return Equirectangular(height, 2 * height)


def convolution_block(
    network: str, in_channels: int, out_channels: int, level: int, *, first: bool = False
) -> nn.Sequential:
    """Return a convolution, a normalisation and a ReLU.

    Args:
        network: one of ``SPHERE_NETWORKS``.
        in_channels: of the values given.
        out_channels: of the result.
        level: of the icosphere; images need none.
        first: whether values are the network's input, which has no orientations yet.
    """
    if network == "crown":
        crown = CrownConv2d(in_channels, out_channels)
        relu = CrownPointwise(nn.ReLU())
        return nn.Sequential(crown, CrownBatchNorm2d(out_channels), relu, CrownExchange())
    if network == "hex":
        hexagonal = HexConv2d(in_channels, out_channels, orientation="north", level=level)
        return nn.Sequential(hexagonal, nn.BatchNorm1d(out_channels), nn.ReLU())
    layer: nn.Module
    if network == "hexgroup":
        layer = (HexLiftConv2d if first else HexGroupConv2d)(in_channels, out_channels, level)
    elif network == "sphere":
        layer = SphereConv2d(in_channels, out_channels, bias=False)
    else:
        layer = nn.Conv2d(in_channels, out_channels, 3, padding=1, bias=False)
    return nn.Sequential(layer, nn.BatchNorm2d(out_channels), nn.ReLU())


def pooling(network: str, level: int) -> nn.Module:
    """Return the step to half the resolution."""
    if network == "crown":
        return CrownAvgPool2d()
    return IcospherePool(level) if network in _ON_ICOSPHERES else nn.AvgPool2d(2)


class SphereNetwork(nn.Module):
    """Base of the small networks: grid, hyper-parameters, and the check of inputs.

    Args:
        network: one of ``SPHERE_NETWORKS``.
        level: of the icosphere, 3 or more; equirectangular images have about as many pixels.
        num_classes: number of logits.
        in_channels: of the values given.
        width: channels at the finest level, those of ``WIDTHS`` when not given.

    Raises:
        ArgumentError: if the network is unknown or the level below 3.
    """

    def __init__(
        self, network: str, level: int, num_classes: int, in_channels: int, width: int | None = None
    ) -> None:
        super().__init__()
        self.grid = network_grid(network, level)
        self.network, self.level = network, level
        self.num_classes, self.in_channels = num_classes, in_channels
        self.width = WIDTHS[network] if width is None else width

    @property
    def hyperparameters(self) -> dict[str, Any]:
        """Plain scalars that rebuild this network: ``type(net)(**net.hyperparameters)``."""
        names = ("network", "level", "num_classes", "in_channels", "width")
        return {name: getattr(self, name) for name in names}

    def check_values(self, values: Float[Tensor, "B C_in *grid"]) -> None:
        """Raise ``ShapeError`` unless values are ``(B, in_channels, *grid.shape)``."""
        if tuple(values.shape[1:]) != (self.in_channels, *self.grid.shape):
            size = ", ".join(map(str, (self.in_channels, *self.grid.shape)))
            raise ShapeError(f"values: expected shape (B, {size}), got {tuple(values.shape)}")
