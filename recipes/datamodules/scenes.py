# SPDX-License-Identifier: Apache-2.0
"""Rendered scenes as training, validation and test data."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Annotated, Literal

import torch
from annotated_types import Len
from torch.utils.data import DataLoader, Dataset, Subset

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError
from sphericalvision.data import PhotometricAugmentation, RotateFivefold
from sphericalvision.data.augmentation.transforms import Compose
from sphericalvision.recipes.app.cli import track
from sphericalvision.recipes.app.kinds import Count, Number, Positive, Size, Text
from sphericalvision.recipes.datamodules.data_module import Sample
from sphericalvision.recipes.datamodules.depth_data_module import DepthDataModule, Entries
from sphericalvision.scenes import World, WorldSamples
from sphericalvision.scenes.meshes import mesh_files
from sphericalvision.scenes.world import HELD_OUT_SEED


class Augmented(Dataset[Sample]):
    """A data set with a transform on each sample."""

    def __init__(self, dataset: Dataset[Sample], transform: Callable[[Sample], Sample]) -> None:
        self.dataset, self.transform = dataset, transform

    def __len__(self) -> int:
        return len(self.dataset)  # type: ignore[arg-type]

    def __getitem__(self, index: int) -> Sample:
        return self.transform(self.dataset[index])


@dataclass(eq=False, repr=False, kw_only=True)
class RenderedDataModule(DepthDataModule):
    """Samples that are rendered: those of training, validation and test come from disjoint ranges of seeds."""

    num_train: Count = 1000
    num_val: Count = 32
    num_test: Count = 64
    train_seed: Number = 0
    val_seed: Number = 1_000_000
    test_seed: Number = 2_000_000
    samples_per_pixel: Count = 4
    augment: bool = True
    cache_dir: Text | None = None

    of_training = ("seed", "augment")

    def __post_init__(self) -> None:
        super().__post_init__()
        held_out = {"val": (self.num_val, self.val_seed), "test": (self.num_test, self.test_seed)}
        self.scenes = {"train": (self.num_train, self.train_seed), **held_out}
        seeds = {**self.training_seeds(), **held_out}
        for split, (count, first) in seeds.items():
            if first + count > HELD_OUT_SEED:
                raise ArgumentError(
                    f"data: seeds from {HELD_OUT_SEED} are held out for the benchmark, and {split} scenes end at "
                    f"{first + count - 1}; set data.{split}_seed to {HELD_OUT_SEED - count} or less"
                )
        ranges = sorted((first, first + count, split) for split, (count, first) in seeds.items())
        for (_, end, one), (start, _, other) in pairwise(ranges):
            if start < end:
                raise ArgumentError(
                    f"data: the seeds of {one} and {other} scenes overlap ({one} ends at {end - 1}, {other} "
                    f"starts at {start}); set data.{other}_seed to {end} or more"
                )

    def training_seeds(self) -> dict[str, tuple[int, int]]:
        """Number and first seed of the training scenes."""
        return {"train": (self.num_train, self.train_seed)}

    def seeds(self, split: str) -> range:
        """The seeds of a split."""
        count, first = self.scenes[split]
        return range(first, first + count)

    def plain(self, split: str) -> Dataset[Sample]:
        """Samples of one split as they are rendered. Every subclass implements it."""
        raise NotImplementedError(f"{type(self).__name__}.plain")

    def dataset(self, split: str) -> Dataset[Sample]:
        """Samples of one split, augmented in "train"."""
        samples = self.plain(split)
        if split != "train" or not self.augment:
            return samples
        return Augmented(samples, self.augmentation())

    def augmentation(self, generator: torch.Generator | None = None) -> Callable[[Sample], Sample]:
        """Random changes of training samples. Every subclass implements it."""
        raise NotImplementedError(f"{type(self).__name__}.augmentation")

    def plain_train_dataset(self) -> Dataset[Sample]:
        """Training samples without augmentation."""
        return self.plain("train")

    def prepare_data(self) -> None:
        """Render, where a cache keeps it, what training and validation will read, so that its progress shows."""
        for split in ("train", "val"):
            self.render(split)

    def render(self, split: str) -> None:
        """Render the samples of a split that are not known to be in the cache; does nothing without a cache."""
        if self.cache_dir is None:
            return
        samples = self.plain(split)
        is_cached = getattr(samples, "is_cached", lambda index: False)
        missing = [index for index in range(len(samples)) if not is_cached(index)]  # type: ignore[arg-type]
        if not missing:
            return
        loader = DataLoader(Subset(samples, missing), batch_size=None, num_workers=self.num_workers)
        for _ in track(loader, f"rendering {split} scenes", total=len(missing)):
            pass


@dataclass(eq=False, repr=False, kw_only=True)
class SceneDataModule(RenderedDataModule):
    """Scenes of one kind or several, seen through one rig.

    ``conf/data/scenes.yaml`` explains its keys.
    """

    rig: CameraRig
    entries: Entries = None
    panorama_size: Size | None = None
    kind: str | list[str] = field(default_factory=lambda: ["room", "floating"])
    antialias: bool = True
    mesh: str | list[str] | None = None
    mesh_up: Literal["y", "z"] = "y"
    mesh_scale: Positive = 1.0
    carrier: str | None = None
    tilts_deg: Annotated[Sequence[float], Len(2, 2)] | None = None

    def augmentation(self, generator: torch.Generator | None = None) -> Callable[[Sample], Sample]:
        """Turns by multiples of 72 degrees, and other colours."""
        return Compose(RotateFivefold(generator), PhotometricAugmentation(generator=generator))

    def plain(self, split: str) -> WorldSamples:
        """Scenes of one split, as rendered.

        Raises:
            ArgumentError: the panorama cannot be turned by multiples of 72 degrees.
        """
        view, size = replace(self.view, antialias=self.antialias), self.panorama_size
        if view.panorama is not None and size is not None:
            view = replace(view, panorama=(int(size[0]), int(size[1])))
        if self.augment and view.panorama is not None and view.panorama[1] % 5:
            raise ArgumentError(
                f"data.panorama_size: turning by multiples of 72 degrees wants a width that is a multiple of 5, got "
                f"{view.panorama[1]}; or set data.augment=false"
            )
        tilts = None if self.tilts_deg is None else [math.radians(tilt) for tilt in self.tilts_deg]
        world = World(
            self.rig,
            self.kind,
            self.min_depth,
            meshes=None if self.mesh is None else mesh_files(self.mesh, self.mesh_up, self.mesh_scale),
            tilts=None if tilts is None else (tilts[0], tilts[1]),
            carrier=self.carrier,
            carrier_counts=True,
            samples_per_pixel=self.samples_per_pixel,
        )
        return WorldSamples(world, view, self.seeds(split), self.cache_dir)
