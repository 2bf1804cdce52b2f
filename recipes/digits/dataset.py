# SPDX-License-Identifier: Apache-2.0
"""The handwritten digits that come with scikit-learn, drawn on a sphere, upright or randomly rotated, as data."""

import functools
import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import Dataset

from sphericalvision.cameras import FisheyeCamera
from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.data import random_rotations
from sphericalvision.data.augmentation.sphere_rotation import source_directions
from sphericalvision.recipes.app.kinds import FullAngle
from sphericalvision.recipes.training.orientations import OrientedDataModule
from sphericalvision.sphere import SphereGrid

ORIENTATIONS = ("upright", "rotated")
"""N and R of the literature's tables."""


@functools.cache
def load_digits() -> tuple[Tensor, Tensor]:
    """Images ``(1797, 1, 8, 8)`` in [0, 1] and labels ``(1797,)``, shuffled once for all.

    Raises:
        ArgumentError: scikit-learn is not installed; the message says how to get it.
    """
    try:
        from sklearn.datasets import load_digits as bundled  # needed by this recipe alone
    except ImportError as error:
        raise ArgumentError(
            "data=digits: the digits come with scikit-learn, which is not installed; "
            "pip install 'sphericalvision[recipes]' brings it"
        ) from error
    content = bundled()
    order = torch.randperm(len(content.target), generator=torch.Generator().manual_seed(0))
    images = torch.from_numpy(content.images).float()[order, None] / 16
    return images, torch.from_numpy(content.target).long()[order]


def draw_on_sphere(
    image: Tensor, grid: SphereGrid, field_of_view: float, rotation: Tensor | None = None
) -> Tensor:
    """Draw a picture on the sphere: upright, its middle straight ahead, then rotated.

    Args:
        image: ``(c, h, w)``.
        grid: where it is drawn.
        field_of_view: angle in radians that the shorter side of the picture covers.
        rotation: ``(3, 3)`` turns what is drawn.

    Returns:
        ``(c, *grid.shape)``, 0 outside the picture.

    References:
        Cohen et al. (2018), "Spherical CNNs", section 5.2, who project stereographically, too.
    """
    lens = FisheyeCamera.from_field_of_view(image.shape[-2:], field_of_view, "stereographic")
    directions = source_directions(grid, torch.eye(3) if rotation is None else rotation)
    values, seen = lens.sample(image, directions)
    return torch.where(seen, values, 0.0).unflatten(-1, grid.shape)


class SphericalDigits(Dataset[dict[str, Any]]):
    """Digits on a grid.

    Args:
        indices: of the digits, in the order of ``load_digits``.
        grid: on which they are drawn.
        orientation: ``"upright"``, or ``"rotated"`` by a random rotation in three dimensions.
        field_of_view: angle in radians that a digit covers.
        seed: with the digit's index it fixes the rotation; None draws a new one each time, from torch's global
            generator, for training.

    Each sample has ``values`` ``(1, *grid.shape)`` and ``label``.
    """

    def __init__(
        self,
        indices: range,
        grid: SphereGrid,
        orientation: str,
        field_of_view: float,
        seed: int | None = None,
    ) -> None:
        check_choice("orientation", orientation, ORIENTATIONS)
        self.indices, self.grid, self.orientation = indices, grid, orientation
        self.field_of_view, self.seed = field_of_view, seed

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, index: int) -> dict[str, Any]:
        images, labels = load_digits()
        digit = self.indices[index]
        if self.orientation == "upright":
            values = self._upright[index, None]
        else:
            generator = None
            if self.seed is not None:
                generator = torch.Generator().manual_seed(self.seed * 1_000_003 + digit)
            rotation = random_rotations(1, generator=generator)[0]
            values = draw_on_sphere(images[digit], self.grid, self.field_of_view, rotation)
        return {"values": values, "label": labels[digit]}

    @functools.cached_property
    def _upright(self) -> Tensor:
        """All digits ``(n, *grid.shape)``, drawn once."""
        images, _ = load_digits()
        return draw_on_sphere(images[list(self.indices), 0], self.grid, self.field_of_view)


NUM_DIGITS = 1797
TEST_SEED = 1


@dataclass(eq=False, repr=False, kw_only=True)
class DigitsDataModule(OrientedDataModule):
    """scikit-learn's digits on the grid of a network; train, validation and test digits are different ones."""

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
