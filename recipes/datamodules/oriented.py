# SPDX-License-Identifier: Apache-2.0
"""What lies on the sphere in several orientations, as training, validation and test data."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar

from torch.utils.data import DataLoader, Dataset

from sphericalvision.core import check_choice
from sphericalvision.models.sphere_blocks import network_grid
from sphericalvision.recipes.app.kinds import Count
from sphericalvision.recipes.datamodules.base import Sample, SampleDataModule

__all__ = ["OrientedDataModule"]


@dataclass(eq=False, repr=False)
class OrientedDataModule(SampleDataModule):
    """Samples on the grid of a network, trained in one orientation, validated and tested in each.

    Args:
        network: whose grid the samples are on, see ``network_grid``.
        level: of the icosphere, or of the equirectangular image with about as many pixels.
        orientation: in training.
        num_val: samples of validation, in each orientation.
        num_test: samples of the test, in each orientation.
    """

    network: str = "hex"
    level: int = 4
    orientation: str = "upright"
    num_val: Count = 20
    num_test: Count = 60

    orientations: ClassVar[Iterable[str]]
    """All that there are."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("data.orientation", self.orientation, tuple(self.orientations))
        self.grid = network_grid(self.network, self.level)

    def dataset(self, split: str) -> Dataset[Sample]:
        """Samples of a split in the orientation of training."""
        return self.samples(split, self.orientation)

    def samples(self, split: str, orientation: str) -> Dataset[Sample]:
        """Samples of a split in any orientation. Every subclass implements it."""
        raise NotImplementedError(f"{type(self).__name__}.samples")

    def val_dataloader(self) -> list[DataLoader[Sample]]:  # type: ignore[override]
        """Validation samples in each orientation."""
        return [self.part_of_process(self.samples("val", name)) for name in self.orientations]

    def test_dataloader(self) -> list[DataLoader[Sample]]:  # type: ignore[override]
        """Test samples in each orientation."""
        return [self.part_of_process(self.samples("test", name)) for name in self.orientations]
