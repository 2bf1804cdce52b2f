# SPDX-License-Identifier: Apache-2.0
"""Labelled rooms as training, validation and test data."""

from __future__ import annotations

from torch.utils.data import DataLoader, Dataset

from sphericalvision.core import check_choice
from sphericalvision.models.sphere_blocks import network_grid
from sphericalvision.recipes.app.kinds import Count, Text
from sphericalvision.recipes.datamodules.base import Sample, SampleDataModule
from sphericalvision.recipes.segmentation.rooms import ORIENTATIONS, LabelledRooms

__all__ = ["LabelledRoomsDataModule"]

FIRST_SEEDS = {"train": 0, "val": 1_000_000, "test": 2_000_000}


class LabelledRoomsDataModule(SampleDataModule):
    """Rooms on the grid of a network; training, validation and test rooms are different ones.

    Args:
        network: whose grid the rooms are seen on, see ``network_grid``.
        level: of the icosphere, or of the equirectangular image with about as many pixels.
        orientation: in training, one of ``ORIENTATIONS``.
        num_train: training rooms.
        num_val: validation rooms.
        num_test: test rooms, seen in every orientation.
        cache_dir: folder where rooms are kept; rendered each time when not given.
        batch_size: samples in a batch.
        num_workers: processes that render; 0 uses the main process.
        seed: of the order in training.
    """

    def __init__(
        self,
        network: str,
        level: int,
        orientation: str = "upright",
        num_train: Count = 400,
        num_val: Count = 20,
        num_test: Count = 60,
        cache_dir: Text | None = None,
        batch_size: int = 8,
        num_workers: int = 0,
        seed: int = 0,
    ) -> None:
        super().__init__(batch_size, num_workers, seed)
        check_choice("data.orientation", orientation, tuple(ORIENTATIONS))
        self.grid = network_grid(network, level)
        self.orientation, self.cache_dir = orientation, cache_dir
        self.numbers = {"train": num_train, "val": num_val, "test": num_test}

    def dataset(self, split: str) -> Dataset[Sample]:
        """Rooms of a split in the orientation of training."""
        return self.rooms(split, self.orientation)

    def rooms(self, split: str, orientation: str) -> LabelledRooms:
        """Rooms of a split in any orientation."""
        return LabelledRooms(FIRST_SEEDS[split], self.numbers[split], self.grid, orientation, self.cache_dir)

    def val_dataloader(self) -> list[DataLoader[Sample]]:  # type: ignore[override]
        """Validation rooms in each of ``ORIENTATIONS``."""
        return [self.part_of_process(self.rooms("val", name)) for name in ORIENTATIONS]

    def test_dataloader(self) -> list[DataLoader[Sample]]:  # type: ignore[override]
        """Test rooms in each of ``ORIENTATIONS``."""
        return [self.part_of_process(self.rooms("test", name)) for name in ORIENTATIONS]
