# SPDX-License-Identifier: Apache-2.0
"""Digits on the sphere as training, validation and test data."""

from __future__ import annotations

import math

from torch.utils.data import DataLoader, Dataset

from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.models.sphere_blocks import network_grid
from sphericalvision.recipes.app.kinds import Count, FullAngle
from sphericalvision.recipes.datamodules.base import Sample, SampleDataModule
from sphericalvision.recipes.digits.dataset import ORIENTATIONS, SphericalDigits

__all__ = ["DigitsDataModule"]

NUM_DIGITS = 1797
TEST_SEED = 1


class DigitsDataModule(SampleDataModule):
    """scikit-learn's digits on the grid of a network; train, validation and test digits are different ones.

    Args:
        network: whose grid the digits are drawn on, see ``network_grid``.
        level: of the icosphere, or of the equirectangular image with about as many pixels.
        orientation: of the digits in training: ``"upright"``, or ``"rotated"`` anew each time.
        field_of_view_deg: angle in degrees that a digit covers.
        num_val: digits for validation.
        num_test: digits for the table.
        batch_size: samples in a batch.
        num_workers: processes that draw digits; 0 uses the main process.
        seed: of order and rotations in training.
    """

    def __init__(
        self,
        network: str,
        level: int,
        orientation: str = "upright",
        field_of_view_deg: FullAngle = 120.0,
        num_val: Count = 200,
        num_test: Count = 500,
        batch_size: int = 32,
        num_workers: int = 0,
        seed: int = 0,
    ) -> None:
        super().__init__(batch_size, num_workers, seed)
        check_choice("data.orientation", orientation, ORIENTATIONS)
        if min(num_val, num_test) < 1 or num_val + num_test >= NUM_DIGITS:
            raise ArgumentError(
                f"data.num_val, data.num_test: expected 1 or more each and fewer than {NUM_DIGITS} together, "
                f"got {num_val} and {num_test}"
            )
        self.grid = network_grid(network, level)
        self.orientation, self.field_of_view = orientation, math.radians(field_of_view_deg)
        num_train = NUM_DIGITS - num_val - num_test
        self.indices = {
            "train": range(num_train),
            "val": range(num_train, num_train + num_val),
            "test": range(num_train + num_val, NUM_DIGITS),
        }

    def dataset(self, split: str) -> Dataset[Sample]:
        """Digits of a split in the orientation of training; new rotations each time in "train"."""
        seed = None if split == "train" else TEST_SEED
        return self.digits(split, self.orientation, seed)

    def digits(self, split: str, orientation: str, seed: int | None = TEST_SEED) -> SphericalDigits:
        """Digits of a split in any orientation."""
        return SphericalDigits(self.indices[split], self.grid, orientation, self.field_of_view, seed)

    def val_dataloader(self) -> list[DataLoader[Sample]]:  # type: ignore[override]
        """Validation digits in each of ``ORIENTATIONS``."""
        return [self.part_of_process(self.digits("val", orientation)) for orientation in ORIENTATIONS]

    def test_dataloader(self) -> list[DataLoader[Sample]]:  # type: ignore[override]
        """Test digits in each of ``ORIENTATIONS``."""
        return [self.part_of_process(self.digits("test", orientation)) for orientation in ORIENTATIONS]
