# SPDX-License-Identifier: Apache-2.0
"""Training, validation and test data for the recipes: rendered scenes, or sets on disk."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
import torch
from rich.progress import track
from torch.utils.data import DataLoader, Dataset

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError
from sphericalvision.data import (
    OmniStereoDataset,
    PhotometricAugmentation,
    RandomShift,
    RotateFivefold,
    SceneDataset,
    ToSphere,
    collate_samples,
)
from sphericalvision.data.transforms import Compose

__all__ = ["DepthDataModule", "OmniStereoDataModule", "SceneDataModule", "TrainingStream"]

ENDLESS = 2**40

Sample = dict[str, Any]


class TrainingStream(Dataset[Sample]):
    """A data set shuffled anew in every round, as one long sequence whose order is known beforehand.

    What stands at a position, augmentation included, depends on the seed and the position alone: not on the
    number of workers, and not on whether training was interrupted before.

    Args:
        dataset: samples by index.
        length: number of positions.
        seed: of the order and of torch's global generator while a sample is made.
        start: position that index 0 stands for, when training resumes.
    """

    def __init__(self, dataset: Dataset[Sample], length: int, seed: int = 0, start: int = 0) -> None:
        self.dataset, self.length, self.seed, self.start = dataset, length, seed, start
        self._round = -1
        self._order: list[int] = []

    def __len__(self) -> int:
        return self.length

    def index_at(self, position: int) -> int:
        """Index of the sample that stands at a position."""
        size = len(self.dataset)  # type: ignore[arg-type]
        shuffle, offset = divmod(position, size)
        if shuffle != self._round:
            generator = torch.Generator().manual_seed(self.seed * 1_000_003 + shuffle)
            self._round, self._order = shuffle, torch.randperm(size, generator=generator).tolist()
        return self._order[offset]

    def __getitem__(self, index: int) -> Sample:
        position = self.start + index
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed((self.seed + 1) * 1_000_000_007 + position)
            return self.dataset[self.index_at(position)]


class Augmented(Dataset[Sample]):
    """A data set with a transform on each sample."""

    def __init__(self, dataset: Dataset[Sample], transform: Callable[[Sample], Sample]) -> None:
        self.dataset, self.transform = dataset, transform

    def __len__(self) -> int:
        return len(self.dataset)  # type: ignore[arg-type]

    def __getitem__(self, index: int) -> Sample:
        return self.transform(self.dataset[index])


class DepthDataModule(pl.LightningDataModule):
    """Loaders over data sets that subclasses make; ``dataset(split)`` is all they need to say.

    Args:
        batch_size: samples in a batch.
        num_workers: processes that prepare samples; 0 uses the main process.
        seed: of order and augmentation in training.
    """

    def __init__(self, batch_size: int = 4, num_workers: int = 0, seed: int = 0) -> None:
        super().__init__()
        if batch_size < 1:
            raise ArgumentError(f"data.batch_size: expected 1 or more, got {batch_size}")
        self.batch_size, self.num_workers, self.seed = batch_size, num_workers, seed
        self.samples_seen = 0

    def dataset(self, split: str) -> Dataset[Sample]:
        """Samples of "train", "val" or "test", on the icosphere; augmented in "train"."""
        raise NotImplementedError

    def plain_train_dataset(self) -> Dataset[Sample]:
        """The training samples without augmentation, in order."""
        return self.dataset("train")

    def render(self, split: str) -> None:
        """Make the samples of a split ready, with progress; data on disk are."""

    def train_dataloader(self) -> DataLoader[Sample]:
        """Endless training batches up to ``trainer.max_steps``, from where a resumed run stopped."""
        steps = self.trainer.max_steps * self.trainer.accumulate_grad_batches if self.trainer else -1
        world = self.trainer.world_size if self.trainer else 1
        length = steps * self.batch_size * world if steps > 0 else ENDLESS
        stream = TrainingStream(self.dataset("train"), length, self.seed, self.samples_seen)
        return self.loader(stream)

    def val_dataloader(self) -> DataLoader[Sample]:
        """Validation batches, in order."""
        return self.loader(self.dataset("val"))

    def test_dataloader(self) -> DataLoader[Sample]:
        """Test batches, in order."""
        return self.loader(self.dataset("test"))

    def loader(self, dataset: Dataset[Sample]) -> DataLoader[Sample]:
        """Batches of any data set of these samples, in order."""
        return DataLoader(
            dataset,
            batch_size=self.batch_size,
            num_workers=self.num_workers,
            collate_fn=collate_samples,
            persistent_workers=self.num_workers > 0,
        )

    def state_dict(self) -> dict[str, int]:
        """What a resumed run must know: how many training samples were used up."""
        assert self.trainer is not None
        per_step = self.batch_size * self.trainer.accumulate_grad_batches * self.trainer.world_size
        return {"samples_seen": self.trainer.global_step * per_step}

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        """Continue behind the samples that were used up."""
        self.samples_seen = state_dict["samples_seen"]


class SceneDataModule(DepthDataModule):
    """Rendered scenes: train, validation and test scenes come from disjoint ranges of seeds.

    Args:
        rig: what the scenes are seen through.
        level: icosphere level of the images.
        min_depth: nearest hypothesis in metres; nearer points are not valid.
        kind: "room", "floating" or "mixed".
        num_train: number of training scenes.
        num_val: number of validation scenes.
        num_test: number of test scenes.
        train_seed: seed of the first training scene.
        val_seed: seed of the first validation scene.
        test_seed: seed of the first test scene.
        samples_per_pixel: rays per image pixel.
        antialias: average images over the area between vertices before they are looked up.
        augment: in training, turn the world by random multiples of 72 degrees and vary colours.
        cache_dir: folder where rendered samples are kept; rendered again each time when not given.
        batch_size: samples in a batch.
        num_workers: processes that prepare samples, and that render before training.
        seed: of the order in training.
    """

    def __init__(
        self,
        rig: CameraRig,
        level: int,
        min_depth: float,
        kind: str = "mixed",
        num_train: int = 1000,
        num_val: int = 32,
        num_test: int = 64,
        train_seed: int = 0,
        val_seed: int = 1_000_000,
        test_seed: int = 2_000_000,
        samples_per_pixel: int = 4,
        antialias: bool = True,
        augment: bool = True,
        cache_dir: str | None = None,
        batch_size: int = 4,
        num_workers: int = 0,
        seed: int = 0,
    ) -> None:
        super().__init__(batch_size, num_workers, seed)
        self.rig, self.cache_dir, self.augment = rig, cache_dir, augment
        self.options = {
            "level": level,
            "kind": kind,
            "samples_per_pixel": samples_per_pixel,
            "antialias": antialias,
            "min_depth": min_depth,
        }
        self.scenes = {
            "train": (num_train, train_seed),
            "val": (num_val, val_seed),
            "test": (num_test, test_seed),
        }
        self._check_disjoint()

    def _check_disjoint(self) -> None:
        ranges = sorted((first, first + number, split) for split, (number, first) in self.scenes.items())
        for (_, end, one), (start, _, other) in pairwise(ranges):
            if start < end:
                raise ArgumentError(
                    f"data: the seeds of {one} and {other} scenes overlap ({one} ends at {end - 1}, {other} "
                    f"starts at {start}); set data.{other}_seed to {end} or more"
                )

    def dataset(self, split: str) -> Dataset[Sample]:
        """Scenes of one split, augmented in "train"."""
        scenes = self.scene_dataset(split)
        if split != "train" or not self.augment:
            return scenes
        return Augmented(scenes, Compose(RotateFivefold(), PhotometricAugmentation()))

    def plain_train_dataset(self) -> SceneDataset:
        """Training scenes without augmentation."""
        return self.scene_dataset("train")

    def scene_dataset(self, split: str) -> SceneDataset:
        """Scenes of one split, as rendered."""
        number, first_seed = self.scenes[split]
        cache = None if self.cache_dir is None else Path(self.cache_dir)
        return SceneDataset(number, self.rig, first_seed=first_seed, cache_dir=cache, **self.options)

    def prepare_data(self) -> None:
        """Render, where a cache keeps it, what training and validation will read, so that its progress shows."""
        for split in ("train", "val"):
            self.render(split)

    def render(self, split: str) -> None:
        """Render the scenes of a split that are not in the cache yet; does nothing without a cache."""
        if self.cache_dir is None:
            return
        scenes = self.scene_dataset(split)
        missing = [i for i in range(len(scenes)) if not scenes.is_cached(i)]
        if not missing:
            return
        subset = torch.utils.data.Subset(scenes, missing)
        loader = DataLoader(subset, batch_size=None, num_workers=self.num_workers)
        for _ in track(loader, f"rendering {split} scenes", total=len(missing)):
            pass


class OmniStereoDataModule(DepthDataModule):
    """OmniThings and its kin from disk, split and augmented as in the paper.

    Args:
        root: folder of the set that is trained on.
        level: icosphere level of the images.
        min_depth: nearest hypothesis in metres of the network; checked against the release.
        dataset: "omnithings", "omnihouse", "sunny", "cloudy" or "sunset".
        protocol: whose splits, "paper" or "official".
        release: "png" or "tiff"; detected when not given.
        missing: "error", or "skip" for a partial copy.
        photometric: augment colours in training.
        shift: standard deviation of the random shift in training, pixels; 0 for none.
        val_split: split that validates.
        test_split: split that tests.
        train_split: split that trains.
        batch_size: samples in a batch.
        num_workers: processes that read samples.
        seed: of order and augmentation in training.
    """

    def __init__(
        self,
        root: str,
        level: int,
        min_depth: float,
        dataset: str = "omnithings",
        protocol: str = "paper",
        release: str | None = None,
        missing: str = "error",
        photometric: bool = True,
        shift: float = 0.5,
        train_split: str = "train",
        val_split: str = "val",
        test_split: str = "test",
        batch_size: int = 4,
        num_workers: int = 4,
        seed: int = 0,
    ) -> None:
        super().__init__(batch_size, num_workers, seed)
        self.level, self.min_depth = level, min_depth
        self.splits = {"train": train_split, "val": val_split, "test": test_split}
        self.photometric, self.shift = photometric, shift
        self.options = {
            "root": root,
            "dataset": dataset,
            "protocol": protocol,
            "release": release,
            "missing": missing,
        }

    def dataset(self, split: str) -> OmniStereoDataset:
        """Frames of one split, augmented in "train"."""
        augment = split == "train"
        stages: list[Callable[[Sample], Sample]] = []
        if augment and self.photometric:
            stages.append(PhotometricAugmentation())
        if augment and self.shift:
            stages.append(RandomShift(self.shift))
        return self._read(split, stages)

    def plain_train_dataset(self) -> OmniStereoDataset:
        """Training frames as they are on disk."""
        return self._read("train", [])

    def _read(self, split: str, stages: list[Callable[[Sample], Sample]]) -> OmniStereoDataset:
        transform = Compose(*stages, ToSphere(self.level))
        frames = OmniStereoDataset(split=self.splits[split], transform=transform, **self.options)
        if abs(frames.min_depth / self.min_depth - 1) > 0.02:
            raise ArgumentError(
                f"data.root: {self.options['root']} has the minimum depth {frames.min_depth:g} m "
                f"({frames.release}), the network {self.min_depth:g} m; set "
                f"model.min_depth={frames.min_depth:g} to work at the scale of the set"
            )
        return frames
