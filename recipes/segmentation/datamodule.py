# SPDX-License-Identifier: Apache-2.0
"""Labelled rooms as training, validation and test data."""

from __future__ import annotations

from dataclasses import dataclass

from sphericalvision.recipes.app.kinds import Count, Text
from sphericalvision.recipes.datamodules.oriented import OrientedDataModule
from sphericalvision.recipes.segmentation.rooms import ORIENTATIONS, LabelledRooms

__all__ = ["LabelledRoomsDataModule"]

FIRST_SEEDS = {"train": 0, "val": 1_000_000, "test": 2_000_000}


@dataclass(eq=False, repr=False, kw_only=True)
class LabelledRoomsDataModule(OrientedDataModule):
    """Rooms on the grid of a network; training, validation and test rooms are different ones.

    Args:
        num_train: training rooms.
        cache_dir: folder where rooms are kept; rendered each time when not given.
    """

    num_train: Count = 400
    cache_dir: Text | None = None

    orientations = ORIENTATIONS

    def samples(self, split: str, orientation: str) -> LabelledRooms:
        """Rooms of a split in any orientation."""
        numbers = {"train": self.num_train, "val": self.num_val, "test": self.num_test}
        return LabelledRooms(FIRST_SEEDS[split], numbers[split], self.grid, orientation, self.cache_dir)
