# SPDX-License-Identifier: Apache-2.0
"""Data modules whose samples have depth, as a network wants them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sphericalvision.recipes.datamodules.base import SampleDataModule
from sphericalvision.recipes.datamodules.entries import Wanted

__all__ = ["DepthDataModule"]


class DepthDataModule(SampleDataModule):
    """Samples with depth, as the network wants them that they are for; a field ``entries`` may ask for others."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.given: Sequence[str] = getattr(self, "entries", None) or ()
        self.wanted = Wanted(tuple(self.given or ("sphere",)))

    def serve(self, net: Any, *more: str, depth_level: int | None = None) -> None:
        """Give samples that suit a network, with ``more`` entries; entries that the configuration names stay."""
        wanted = Wanted.by(net, depth_level)
        entries = tuple(self.given or dict.fromkeys((*wanted.entries, *more)))
        self.wanted = wanted._replace(entries=entries)
