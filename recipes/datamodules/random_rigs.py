# SPDX-License-Identifier: Apache-2.0
"""Scenes of all kinds through rigs of all kinds, as training, validation and test data."""

import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import torch
from annotated_types import Ge, Len, MinLen
from pydantic import with_config
from torch.utils.data import Dataset
from typing_extensions import TypedDict

from sphericalvision.capture.preparation.preparation import Preparation
from sphericalvision.core import ArgumentError
from sphericalvision.data import RotateFivefold, SampleView
from sphericalvision.data.augmentation.fivefold import Mirror
from sphericalvision.data.augmentation.transforms import Compose
from sphericalvision.icosphere import num_icosphere_vertices
from sphericalvision.recipes.app.kinds import STRICT, Count, Number, Positive, Size, Text
from sphericalvision.recipes.datamodules.clues import SamplesWithClues, clue_bytes, prior_of
from sphericalvision.recipes.datamodules.data_module import PreparedSamples, Sample
from sphericalvision.recipes.datamodules.scenes import RenderedDataModule
from sphericalvision.scenes import World, WorldSamples
from sphericalvision.scenes.draws import Draws
from sphericalvision.scenes.random_rigs import LevelOrRandomRigs
from sphericalvision.scenes.world import NATURAL_MIN_DEPTH


@with_config(STRICT)
class LevelSamples(TypedDict):
    """Training samples on icospheres of one level.

    ``seeds`` are the first of them and their number, ``times`` how often each comes while another comes once; and the
    sizes of a batch and of the cameras' images.
    """

    seeds: Annotated[Sequence[Number], Len(2, 2)]
    times: Number
    batch_size: Count
    image_size: Size


class SamplesOfLevels(Dataset[Sample]):
    """Samples on icospheres of several levels: ``entries`` has the level of each, and the index among its samples."""

    def __init__(
        self, of_level: Mapping[int, WorldSamples | SamplesWithClues], entries: Sequence[tuple[int, int]]
    ) -> None:
        self.of_level, self.entries = of_level, entries

    def __len__(self) -> int:
        return len(self.entries)

    def __getitem__(self, index: int) -> Sample:
        level, position = self.entries[index]
        return self.of_level[level][position]

    def is_cached(self, index: int) -> bool:
        """Tell whether what was made for a sample is in the cache."""
        level, position = self.entries[index]
        return self.of_level[level].is_cached(position)


@dataclass(eq=False, repr=False, kw_only=True)
class RandomRigDataModule(PreparedSamples, RenderedDataModule):
    """Samples for a network that is to serve any rig: scene, rig and disturbances follow from the seed.

    Some rigs are level rings of four fisheyes, the common case; the others are ``random_rig``. Some samples are
    disturbed as by cheap cameras (``CameraDisturbance``), with poses a little off, and some are too bright. Some rigs
    stand on something that they see, which is mostly not masked. Most scenes are under a sky that is not theirs, black,
    white, of any colour or cloudy, and a few have no lamps: so meshes and photographs of other people look. Images are
    prepared as in use, and averaged where they are finer than the icosphere.

    A batch of training has rigs of as many cameras each. In training, the world is turned by random multiples of 72
    degrees, and half of the samples on icospheres are mirrored.

    ``conf/data/random_rigs.yaml`` explains its keys.

    References:
        WMGStereo (2025), "What makes good synthetic training data for zero-shot stereo matching?", for diversity
        before realism.
    """

    world: dict[str, Any]
    image_size: Size = (256, 256)
    num_cameras: Annotated[list[Annotated[int, Ge(2)]], MinLen(1)] = field(
        default_factory=lambda: [2, 3, 4, 5, 6]
    )
    levels: dict[int, LevelSamples] | None = None
    clues: Text | None = None
    cache_gb: Positive = 24.0

    of_training = (*RenderedDataModule.of_training, "levels", "clues", "cache_gb")

    def bind_network(self, net: Any, *more: str, depth_level: int | None = None) -> None:
        """Give samples as the network takes them.

        Raises:
            ArgumentError: the network takes another number of cameras, or its nearest hypothesis is not 0.55 m; or
                there are several levels for a network that is not on icospheres.
        """
        if not net.any_cameras and set(self.num_cameras) != {net.num_cameras}:
            raise ArgumentError(
                f"data.num_cameras: {type(net).__name__} takes rigs of {net.num_cameras} cameras alone, and these have "
                f"{', '.join(map(str, self.num_cameras))}; set data.num_cameras=[{net.num_cameras}]"
            )
        if self.levels is not None and net.images != "sphere":
            raise ArgumentError(
                f"data.levels: expected none for {type(net).__name__}, which takes the cameras' images, got "
                f"{', '.join(map(str, self.levels))}; set data.levels=null"
            )
        if abs(net.min_depth / NATURAL_MIN_DEPTH - 1) > 1e-6:
            raise ArgumentError(
                f"model.min_depth: random rigs are in scenes of natural size, for 0.55 m, got {net.min_depth}"
            )
        self.net = net
        super().bind_network(net, *(entry for entry in more if entry != "fisheye"), depth_level=depth_level)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.world_of(self.image_size)  # raises for shares that do not fit
        if self.levels is not None and not self.round_indices:
            raise ArgumentError(
                f"data.levels: expected samples of one level or more, got {dict(self.levels)}"
            )
        if self.clues is not None and (self.levels is None or self.cache_dir is None):
            raise ArgumentError(
                "data.clues: expected null without data.levels and data.cache_dir, where clues are kept"
            )

    def training_seeds(self) -> dict[str, tuple[int, int]]:
        """Count and first seed of the training samples, by level if there are several."""
        if self.levels is None:
            return super().training_seeds()
        return {
            f"levels.{level}": (part["seeds"][1], part["seeds"][0]) for level, part in self.levels.items()
        }

    @cached_property
    def round_indices(self) -> list[tuple[int, int]]:
        """Level, and index among its samples, of each training sample in a round."""
        levels = self.levels or {}
        return [
            (level, index)
            for level, part in levels.items()
            for _ in range(part["times"])
            for index in range(part["seeds"][1])
        ]

    def rigs(self, size: Sequence[int]) -> LevelOrRandomRigs:
        """The distribution of rigs, with cameras of a size."""
        return LevelOrRandomRigs(
            self.world["level_rigs"], (int(size[0]), int(size[1])), tuple(self.num_cameras)
        )

    def world_of(self, size: Sequence[int]) -> World:
        """The world through cameras of a size."""
        return World.of(
            {name: value for name, value in self.world.items() if name != "level_rigs"},
            rig=self.rigs(size),
            prepare=Preparation(self.photometric).of_images,
            samples_per_pixel=self.samples_per_pixel,
        )

    def augmentation(self, generator: torch.Generator | None = None) -> Callable[[Sample], Sample]:
        """Turns by multiples of 72 degrees; on icospheres mirror images, too."""
        turned = RotateFivefold(generator)
        return turned if self.view.images else Compose(Mirror(0.5, generator), turned)

    def plain(self, split: str) -> Dataset[Sample]:
        """Samples of one split as they are kept."""
        view = replace(self.view, antialias=True)
        if split == "train" and self.levels is not None:
            of_level = {
                level: self.at_level(replace(view, level=level, depth_level=level), part)
                for level, part in self.levels.items()
                if part["times"]
            }
            return SamplesOfLevels(of_level, self.round_indices)
        return WorldSamples(self.world_of(self.image_size), view, self.seeds(split), self.cache_dir)

    def prepare_data(self) -> None:
        """Make what training and validation will read, where a cache keeps it.

        Raises:
            ArgumentError: it would be larger than ``cache_gb``, or than the disk.
        """
        if self.cache_dir is not None:
            folder = Path(self.cache_dir)
            folder.mkdir(parents=True, exist_ok=True)
            self._check_space(folder)
        super().prepare_data()

    def _check_space(self, folder: Path) -> None:
        """Compare the size of all samples with its bound, and the size of missing ones with the disk."""
        size = self.cache_bytes
        fewer = f"set fewer samples ({'data.num_train' if self.levels is None else 'data.levels'})"
        if size > self.cache_gb * 1e9:
            raise ArgumentError(
                f"data.cache_gb: the training samples take up to {size / 1e9:.1f} GB, more than "
                f"{self.cache_gb:g}; set data.cache_gb={math.ceil(size / 1e9)}, or {fewer}"
            )
        samples: Any = self.plain("train")
        sets = samples.of_level.values() if isinstance(samples, SamplesOfLevels) else [samples]
        missing = sum(not each.is_cached(index) for each in sets for index in range(len(each)))
        missing_size = size * missing / sum(map(len, sets))
        free = shutil.disk_usage(folder).free
        if missing_size > free:
            raise ArgumentError(
                f"data.cache_dir: {folder} has {free / 1e9:.1f} GB free, the samples to come take up to "
                f"{missing_size / 1e9:.1f}; free the disk, choose another data.cache_dir=..., or {fewer}"
            )

    @property
    def cache_bytes(self) -> int:
        """Size of all training samples at most, as they are kept."""
        if self.cache_dir is None:
            return 0
        if self.levels is None:
            return self.num_train * self._sample_bytes(self.view.level or self.view.depth_level or 0)
        return sum(
            part["seeds"][1] * self._sample_bytes(level)
            for level, part in self.levels.items()
            if part["times"]
        )

    def _sample_bytes(self, level: int) -> int:
        """Size of a sample of the most cameras, without compression: images, their masks, depth, clues."""
        cameras = max(4 if self.world["level_rigs"] else 0, *self.num_cameras)
        size = num_icosphere_vertices(level) * (cameras * (3 + 1) + 4)
        if self.view.images:
            size += cameras * (3 + 1) * math.prod(self.image_size)
        return size + (0 if self.clues is None else clue_bytes(self.net, level))

    def at_level(self, view: SampleView, part: LevelSamples) -> WorldSamples | SamplesWithClues:
        """Training samples of one level, with clues if these are kept."""
        seeds = _seeds_of(part)
        samples = WorldSamples(self.world_of(part["image_size"]), view, seeds, self.cache_dir, as_bytes=True)
        if self.clues is None:
            return samples
        assert self.cache_dir is not None
        return SamplesWithClues(samples, self.net, prior_of(self.clues), self.cache_dir)

    def group(self, index: int) -> tuple[int | None, int, bool]:
        """Level, position of cameras and kind of lens of a training sample."""
        if self.levels is None:
            return (None, *self.rigs(self.image_size).kind(Draws.of(self.seeds("train")[index]).rig))
        level, position = self.round_indices[index]
        seed = _seeds_of(self.levels[level])[position]
        return (level, *self.rigs(self.image_size).kind(Draws.of(seed).rig))

    @property
    def batch_sizes(self) -> int | Callable[[Any], int]:
        """Samples in a training batch, by level if there are several."""
        levels = self.levels
        return self.batch_size if levels is None else lambda group: levels[group[0]]["batch_size"]


def _seeds_of(part: LevelSamples) -> range:
    first, count = part["seeds"]
    return range(first, first + count)
