# SPDX-License-Identifier: Apache-2.0
"""Rooms on a grid of the sphere, each place with its colour and what it shows, upright or turned, as data."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import Dataset

from sphericalvision.core import check_choice
from sphericalvision.data import random_rotations
from sphericalvision.data.augmentation.sphere_rotation import source_directions
from sphericalvision.geometry import transform_from_axis_angle
from sphericalvision.recipes.app.kinds import Count, Text
from sphericalvision.recipes.training.orientations import OrientedDataModule
from sphericalvision.scenes import make_scene, ray_labels, render_directions
from sphericalvision.scenes.cache import ArrayCache, decode, encode
from sphericalvision.sphere import SphereGrid
from sphericalvision.sphere.intake import signed

ORIENTATIONS = {"upright": 0.0, "tilted_15": 15.0, "tilted_45": 45.0, "tilted_90": 90.0, "rotated": None}
"""Degrees by which a room is tilted, about a horizontal axis of a random azimuth; None: any rotation."""


def orientation_rotation(orientation: str, seed: int) -> Tensor:
    """The rotation ``(3, 3)`` of a sample, fixed by its seed.

    Examples:
        >>> orientation_rotation("upright", 3).tolist() == torch.eye(3).tolist()
        True
        >>> down = orientation_rotation("tilted_90", 3) @ torch.tensor([0.0, 1.0, 0.0])
        >>> abs(float(down[1])) < 1e-5  # what was below is at the horizon
        True
    """
    check_choice("orientation", orientation, tuple(ORIENTATIONS))
    generator = torch.Generator().manual_seed(seed)
    degrees = ORIENTATIONS[orientation]
    if degrees is None:
        return random_rotations(1, generator=generator)[0].float()
    azimuth = 2 * math.pi * torch.rand((), generator=generator)
    axis = torch.stack((azimuth.cos(), torch.zeros(()), azimuth.sin()))
    return transform_from_axis_angle(axis * math.radians(degrees), torch.zeros(3))[:3, :3]


class LabelledRooms(Dataset[dict[str, Any]]):
    """Furnished rooms, seen from their middle.

    Args:
        first_seed: of sample 0; each sample is a room of its own.
        number: of samples.
        grid: places that are looked at.
        orientation: one of ``ORIENTATIONS``.
        cache_dir: folder where samples are kept; rendered each time when not given.

    Each sample has ``values`` ``(3, *grid.shape)`` in [-1, 1] and ``label`` ``(*grid.shape)``, numbers of
    ``SURFACE_LABELS``, -1 where nothing is.
    """

    def __init__(
        self, first_seed: int, number: int, grid: SphereGrid, orientation: str, cache_dir: str | None = None
    ) -> None:
        self.first_seed, self.number, self.grid, self.orientation = first_seed, number, grid, orientation
        size = "-".join(map(str, grid.shape))
        folder = None if cache_dir is None else Path(cache_dir) / f"labelled-{size}-{orientation}"
        self.cache = ArrayCache(folder)

    def __len__(self) -> int:
        return self.number

    def __getitem__(self, index: int) -> dict[str, Any]:
        seed = self.first_seed + range(self.number)[index]
        arrays = self.cache.get(f"{seed:08d}", lambda: self._render(seed))
        return {"values": signed(decode(arrays["values"])), "label": arrays["label"].long()}

    def _render(self, seed: int) -> dict[str, Tensor]:
        scene = make_scene("room", seed)
        rotation = orientation_rotation(self.orientation, seed)
        directions = source_directions(self.grid, rotation).float().view(*self.grid.shape, 3)
        colors = render_directions(scene, torch.zeros(3), directions)
        labels = ray_labels(scene, torch.zeros(3), directions)
        return {"values": encode(colors), "label": labels.to(torch.int8)}


FIRST_SEEDS = {"train": 0, "val": 1_000_000, "test": 2_000_000}


@dataclass(eq=False, repr=False, kw_only=True)
class LabelledRoomsDataModule(OrientedDataModule):
    """Rooms on the grid of a network; training, validation and test rooms are different ones."""

    num_train: Count = 400
    cache_dir: Text | None = None

    orientations = ORIENTATIONS

    def samples(self, split: str, orientation: str) -> LabelledRooms:
        """Rooms of a split in any orientation."""
        numbers = {"train": self.num_train, "val": self.num_val, "test": self.num_test}
        return LabelledRooms(FIRST_SEEDS[split], numbers[split], self.grid, orientation, self.cache_dir)
