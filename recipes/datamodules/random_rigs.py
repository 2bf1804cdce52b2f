# SPDX-License-Identifier: Apache-2.0
"""Scenes of all kinds through rigs of all kinds, as training, validation and test data."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Any

import torch
from annotated_types import Ge, MinLen
from pydantic import with_config
from torch.utils.data import Dataset
from typing_extensions import TypedDict

from sphericalvision.capture.preparation.preparation import Preparation
from sphericalvision.core import ArgumentError
from sphericalvision.data import RotateFivefold
from sphericalvision.data.augmentation.fivefold import Mirror
from sphericalvision.data.augmentation.transforms import Compose
from sphericalvision.recipes.app.kinds import STRICT, Count, Share, Size
from sphericalvision.recipes.datamodules.ahead import ReusedBatches
from sphericalvision.recipes.datamodules.data_module import PreparedSamples, Sample
from sphericalvision.recipes.datamodules.scenes import RenderedDataModule
from sphericalvision.scenes import World, WorldSamples
from sphericalvision.scenes.draws import Draws
from sphericalvision.scenes.random_rigs import LevelOrRandomRigs
from sphericalvision.scenes.world import NATURAL_MIN_DEPTH

__all__ = ["RandomRigDataModule"]


@with_config(STRICT)
class LevelSamples(TypedDict):
    """Training samples on icospheres of one level: how often a batch is of them, its size, and that of the images."""

    share: Share
    batch_size: Count
    image_size: Size


class SamplesOfLevels(Dataset[Sample]):
    """Samples of which each is on an icosphere of the level that is drawn for it.

    Args:
        parts: the same seeds at each level.
        level_of: the level of a sample, by its index.
    """

    def __init__(self, parts: Mapping[int, Dataset[Sample]], level_of: Callable[[int], int]) -> None:
        self.parts, self.level_of = parts, level_of

    def __len__(self) -> int:
        return len(next(iter(self.parts.values())))  # type: ignore[arg-type]

    def __getitem__(self, index: int) -> Sample:
        return self.parts[self.level_of(index)][index]

    def is_cached(self, index: int) -> bool:
        """Whether what was rendered for a sample lies in the cache."""
        return self.parts[self.level_of(index)].is_cached(index)  # type: ignore[attr-defined,no-any-return]


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

    A device may be faster than the processes that render. With ``uses``, it then takes a batch again, turned and
    mirrored anew, in place of waiting. What is kept in a cache, and what the main process renders, is used once.

    Args:
        world: what comes how often, and faults, as ``conf/world/random_rigs.yaml``.
        image_size: height and width of the cameras.
        num_cameras: of random rigs; level rings have four.
        levels: of icospheres that training samples are on, for a network that is to serve several: its own when not
            given. Validation and tests are at the network's own level.
        uses: how often a training batch is used at most, while the next is not ready.

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
    uses: Count = 1

    of_training = (*RenderedDataModule.of_training, "levels", "uses")
    made_before = ("val",)

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
        super().bind_network(net, *(entry for entry in more if entry != "fisheye"), depth_level=depth_level)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.world_of(self.image_size)  # raises for shares that do not fit
        if self.levels is not None and not sum(part["share"] for part in self.levels.values()) > 0:
            raise ArgumentError(f"data.levels: expected shares above 0, got {dict(self.levels)}")

    def rigs(self, size: Sequence[int]) -> LevelOrRandomRigs:
        """What draws rigs of cameras of a size."""
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
            parts = {
                level: WorldSamples(
                    self.world_of(part["image_size"]),
                    replace(view, level=level, depth_level=level),
                    self.seeds(split),
                    self.cache_dir,
                    as_bytes=True,
                )
                for level, part in self.levels.items()
            }
            return SamplesOfLevels(parts, self.level_of)
        return WorldSamples(self.world_of(self.image_size), view, self.seeds(split), self.cache_dir)

    @property
    def level_of(self) -> Callable[[int], int]:
        """The level of a training sample, by its index. As many batches as the shares say are of each."""
        assert self.levels is not None
        samples = {level: part["share"] * part["batch_size"] for level, part in self.levels.items()}
        return partial(_drawn_level, samples, self.seeds("train"))

    def group(self, index: int) -> tuple[int | None, int, bool]:
        """Level, number of cameras and kind of lens of a training sample."""
        draws = Draws.of(self.seeds("train")[index])
        level = None if self.levels is None else self.level_of(index)
        return (level, *self.rigs(self.image_size).kind(draws.rig))

    @property
    def batch_sizes(self) -> int | Callable[[Any], int]:
        """Samples in a training batch: those of its level."""
        if self.levels is None:
            return self.batch_size
        sizes = {level: part["batch_size"] for level, part in self.levels.items()}
        return partial(_size_for, sizes)

    def train_dataloader(self) -> Any:
        """Endless training batches, some of them again where the next is not ready."""
        loader = super().train_dataloader()
        if self.uses == 1 or self.num_workers == 0 or self.cache_dir is not None:
            return loader
        generator = torch.Generator().manual_seed(self.seed)
        return ReusedBatches(loader, self.uses, self.augmentation(generator), pinned=loader.pin_memory)


# Functions of the module, as processes of a loader take them along: with a method they would take the trainer, too.


def _drawn_level(samples: Mapping[int, float], seeds: Sequence[int], index: int) -> int:
    """One of the levels for the sample of a seed, as often as it has samples."""
    return random.Random(seeds[index]).choices(list(samples), list(samples.values()))[0]


def _size_for(sizes: Mapping[int, int], group: tuple[int, int, bool]) -> int:
    """Samples in a batch of a group."""
    return sizes[group[0]]
