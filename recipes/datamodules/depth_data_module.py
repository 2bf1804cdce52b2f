# SPDX-License-Identifier: Apache-2.0
"""Data modules whose samples have depth, as a network takes them."""

from __future__ import annotations

from typing import Any

from sphericalvision.data import SampleView
from sphericalvision.recipes.datamodules.data_module import SampleDataModule
from sphericalvision.recipes.datamodules.entries import Entries, view_of, view_with
from sphericalvision.scenes.world import NATURAL_MIN_DEPTH

__all__ = ["DepthDataModule"]


class DepthDataModule(SampleDataModule):
    """Samples with depth, as the network takes them that they are for; a field ``entries`` may ask for others."""

    entries: Entries = None

    @property
    def usual_panorama(self) -> tuple[int, int]:
        """(height, width) of panoramas of depth for networks that are not on panoramas."""
        return 80, 160

    def __post_init__(self) -> None:
        super().__post_init__()
        self.min_depth = NATURAL_MIN_DEPTH
        self.view = view_with(self.entries or ("sphere",), SampleView(5, 3, True, self.usual_panorama))

    def bind_network(self, net: Any, *more: str, depth_level: int | None = None) -> None:
        """Give samples that suit a network, with ``more`` entries; entries that the configuration names stay."""
        self.min_depth = net.min_depth
        self.view = view_of(net, self.entries or (), more, depth_level, self.usual_panorama)
