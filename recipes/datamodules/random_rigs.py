# SPDX-License-Identifier: Apache-2.0
"""Scenes of all kinds through rigs of all kinds, as training, validation and test data."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from rich.progress import track
from torch.utils.data import Dataset

from sphericalvision.capture.preparation.preparation import Preparation
from sphericalvision.core import ArgumentError
from sphericalvision.data import RotateFivefold
from sphericalvision.data.augmentation.mirror import Mirror
from sphericalvision.data.augmentation.transforms import Compose
from sphericalvision.models import DepthNetwork
from sphericalvision.recipes.app.kinds import Count, Number, Positive, Share, Size, Text
from sphericalvision.recipes.datamodules.base import Sample, SampleDataModule
from sphericalvision.recipes.datamodules.scenes import Augmented
from sphericalvision.scenes.cache import ArrayCache
from sphericalvision.scenes.random_rig_scenes import RandomRigScenes

__all__ = ["RandomRigDataModule"]


class WithFixedInputs(Dataset[Sample]):
    """Samples with what a network computes of them before anything that is trained, kept beside them.

    Args:
        scenes: the samples.
        net: whose ``fixed_inputs`` are wanted; its state says which folder they are in.
        cache_dir: folder; computed each time when not given.
    """

    def __init__(self, scenes: RandomRigScenes, net: DepthNetwork, cache_dir: str | None) -> None:
        self.scenes, self.net = scenes, net
        folder = None if cache_dir is None else Path(cache_dir) / scenes.name / f"fixed-{fingerprint(net)}"
        self.cache = ArrayCache(folder)

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, index: int) -> Sample:
        sample = self.scenes[index]
        fixed = self.cache.get(sample["frame"], lambda: self._compute(sample))
        return {**sample, "fixed": fixed} if fixed else sample

    def _compute(self, sample: Sample) -> dict[str, torch.Tensor]:
        images, seen = sample["images"][None], sample["seen"][None]
        kept = self.net.fixed_inputs(images, sample["rig"], seen)
        return {name: values[0] for name, values in kept.items()}


class RandomRigDataModule(SampleDataModule):
    """``RandomRigScenes``: train, validation and test samples come from disjoint ranges of seeds.

    Samples have different numbers of cameras, so batches are of one; ``trainer.accumulate_grad_batches`` makes steps of
    several.

    Args:
        level: icosphere level of the images.
        min_depth: nearest hypothesis of the network in metres; scenes are at natural size, for 0.55.
        shares: how often each kind of scene comes, in place of what ``world`` says; so are the next two.
        level_rigs: share of level rings of four.
        disturbed: share of samples with faults of cameras.
        world: what comes how often, and faults, as ``conf/world/random_rigs.yaml``.
        image_size: height and width of the cameras.
        samples_per_pixel: rays per pixel.
        num_train: number of training samples.
        num_val: number of validation samples.
        num_test: number of test samples.
        train_seed: seed of the first training sample.
        val_seed: seed of the first validation sample.
        test_seed: seed of the first test sample.
        augment: in training, turn the world by random multiples of 72 degrees, and mirror half of the samples.
        cache_dir: folder where samples are kept, and what a network computes of them before anything that is trained.
        batch_size: 1.
        num_workers: processes that prepare samples.
        seed: of the order in training.
        **preparation: what is done to images, as of ``Preparation``.
    """

    def __init__(
        self,
        level: int | None = None,
        min_depth: Positive | None = None,
        shares: Mapping[str, float] | None = None,
        level_rigs: Share | None = None,
        disturbed: Share | None = None,
        world: dict[str, Any] | None = None,
        image_size: Size = (256, 256),
        samples_per_pixel: Count = 1,
        num_train: Count = 4000,
        num_val: Count = 28,
        num_test: Count = 56,
        train_seed: Number = 0,
        val_seed: Number = 1_000_000,
        test_seed: Number = 2_000_000,
        augment: bool = True,
        cache_dir: Text | None = None,
        batch_size: int = 1,
        num_workers: int = 0,
        seed: int = 0,
        **preparation: bool,
    ) -> None:
        if batch_size != 1:
            raise ArgumentError(
                f"data.batch_size: expected 1, as rigs differ, got {batch_size}; set trainer.accumulate_grad_batches"
            )
        super().__init__(batch_size, num_workers, seed)
        self.level, self.min_depth = level, min_depth
        self.depth_level: int | None = None
        self.options: dict[str, Any] = {
            "shares": None if shares is None else dict(shares),
            "level_rigs": level_rigs,
            "disturbed": disturbed,
            "values": world,
            "image_size": (int(image_size[0]), int(image_size[1])),
            "samples_per_pixel": samples_per_pixel,
            "prepare": Preparation(**preparation).of_images,
        }
        self.augment, self.cache_dir = augment, cache_dir
        self.scenes = {
            "train": (num_train, train_seed),
            "val": (num_val, val_seed),
            "test": (num_test, test_seed),
        }
        self.net: DepthNetwork | None = None

    def serve(self, net: Any, *more: str, depth_level: int | None = None) -> None:
        """Give samples on the network's icospheres, and keep what it computes of them before anything trained.

        Raises:
            ArgumentError: the network is not one on icospheres, or of another level than given, or its nearest
                hypothesis is not 0.55 m.
        """
        if net.images != "sphere" or net.depth_level is None:
            raise ArgumentError(f"data: random rigs are for networks on icospheres, not {type(net).__name__}")
        if abs(net.min_depth / 0.55 - 1) > 1e-6:
            raise ArgumentError(
                f"model.min_depth: random rigs are in scenes of natural size, for 0.55 m, got {net.min_depth}"
            )
        if self.level not in (None, net.level):
            raise ArgumentError(
                f"data.level: the network takes images of level {net.level}, got {self.level}; leave data.level out"
            )
        self.net = net
        self.level = net.level
        self.depth_level = net.depth_level if depth_level is None else depth_level

    def dataset(self, split: str) -> Dataset[Sample]:
        """Samples of one split, turned and mirrored at random in "train"."""
        samples = self.plain(split)
        if split != "train" or not self.augment:
            return samples
        return Augmented(samples, Compose(Mirror(0.5), RotateFivefold()))

    def plain_train_dataset(self) -> Dataset[Sample]:
        """Training samples without augmentation."""
        return self.plain("train")

    def plain(self, split: str) -> Dataset[Sample]:
        """Samples of one split as they are kept."""
        number, first_seed = self.scenes[split]
        scenes = RandomRigScenes(
            number, first_seed, self.level or 6, self.depth_level, cache_dir=self.cache_dir, **self.options
        )
        return scenes if self.net is None else WithFixedInputs(scenes, self.net, self.cache_dir)

    def prepare_data(self) -> None:
        """Make validation samples ready, so that their progress shows; training makes its own as it goes."""
        self.render("val")

    def render(self, split: str) -> None:
        """Make the samples of a split ready; does nothing without a cache."""
        if self.cache_dir is not None:
            samples = self.plain(split)
            for index in track(range(self.scenes[split][0]), f"rendering {split} samples"):
                samples[index]


def fingerprint(net: DepthNetwork) -> str:
    """Eight letters for the parts of a network that are not trained."""
    shape = {key: value for key, value in net.hyperparameters.items() if key in (net.fixed_by or (key,))}
    fixed = [f"{type(net).__name__} {shape}".encode()]
    fixed += [
        name.encode() + parameter.detach().cpu().numpy().tobytes()
        for name, parameter in net.named_parameters()
        if not parameter.requires_grad
    ]
    return hashlib.sha256(b"".join(fixed)).hexdigest()[:8]
