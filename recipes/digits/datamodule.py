# SPDX-License-Identifier: Apache-2.0
"""Digits on the sphere as training, validation and test data."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sphericalvision.core import ArgumentError
from sphericalvision.recipes.app.kinds import FullAngle
from sphericalvision.recipes.datamodules.oriented import OrientedDataModule
from sphericalvision.recipes.digits.dataset import ORIENTATIONS, SphericalDigits

__all__ = ["DigitsDataModule"]

NUM_DIGITS = 1797
TEST_SEED = 1


@dataclass(eq=False, repr=False, kw_only=True)
class DigitsDataModule(OrientedDataModule):
    """scikit-learn's digits on the grid of a network; train, validation and test digits are different ones.

    Args:
        field_of_view_deg: angle in degrees that a digit covers.
    """

    field_of_view_deg: FullAngle = 120.0

    orientations = ORIENTATIONS

    def __post_init__(self) -> None:
        super().__post_init__()
        num_train = NUM_DIGITS - self.num_val - self.num_test
        if num_train < 1:
            raise ArgumentError(
                f"data.num_val, data.num_test: expected fewer than {NUM_DIGITS} together, got {self.num_val} and "
                f"{self.num_test}"
            )
        self.indices = {
            "train": range(num_train),
            "val": range(num_train, num_train + self.num_val),
            "test": range(num_train + self.num_val, NUM_DIGITS),
        }

    def samples(self, split: str, orientation: str) -> SphericalDigits:
        """Digits of a split in any orientation; new rotations each time in "train"."""
        seed = None if split == "train" else TEST_SEED
        angle = math.radians(self.field_of_view_deg)
        return SphericalDigits(self.indices[split], self.grid, orientation, angle, seed)
