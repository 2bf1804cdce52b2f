# SPDX-License-Identifier: Apache-2.0
"""Rendered scenes as training, validation and test data."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Annotated, Any, Literal

import torch
from annotated_types import Len, MinLen
from rich.progress import track
from torch.utils.data import DataLoader, Dataset

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError
from sphericalvision.data import PhotometricAugmentation, RotateFivefold
from sphericalvision.data.augmentation.transforms import Compose
from sphericalvision.recipes.app.kinds import Count, Number, Positive, Size, Text
from sphericalvision.recipes.datamodules.base import Sample, SampleDataModule
from sphericalvision.recipes.datamodules.entries import Wanted
from sphericalvision.scenes import SceneDataset
from sphericalvision.scenes.meshes import mesh_files
from sphericalvision.scenes.world import HELD_OUT_SEED

__all__ = ["Augmented", "SceneDataModule"]


class Augmented(Dataset[Sample]):
    """A data set with a transform on each sample."""

    def __init__(self, dataset: Dataset[Sample], transform: Callable[[Sample], Sample]) -> None:
        self.dataset, self.transform = dataset, transform

    def __len__(self) -> int:
        return len(self.dataset)  # type: ignore[arg-type]

    def __getitem__(self, index: int) -> Sample:
        return self.transform(self.dataset[index])


class SceneDataModule(SampleDataModule):
    """Rendered scenes: train, validation and test scenes come from disjoint ranges of seeds.

    Args:
        rig: what the scenes are seen through.
        level: icosphere level of the images on the sphere.
        depth_level: icosphere level of the depth.
        min_depth: nearest hypothesis in metres; nearer points are not valid.
        entries: what samples hold: some of "sphere", "depth", "fisheye", "panorama".
        panorama_size: height and width of the depth panorama; for augmentation the width is a multiple of 5.
        kind: of ``make_scene``, or a mixture: "mixed" or "all".
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
        mesh: file of a textured mesh, several, or a folder: scenes are free places in it, in place of a kind.
        mesh_up: axis that points up in it, "y" (glTF) or "z".
        mesh_scale: metres in one unit of it.
        carrier: what carries the rig and is in view: "pole", "robot" or "vehicle"; nothing when not given.
        tilts_deg: least and largest degrees by which the cameras look further down in training and validation, drawn
            for each scene; see ``SceneDataset``. The rig as it is when not given, as in the test.
    """

    def __init__(
        self,
        rig: CameraRig,
        level: int | None = None,
        depth_level: int | None = None,
        min_depth: Positive | None = None,
        entries: Annotated[Sequence[str], MinLen(1)] | None = None,
        panorama_size: Size | None = None,
        kind: str = "mixed",
        num_train: Count = 1000,
        num_val: Count = 32,
        num_test: Count = 64,
        train_seed: Number = 0,
        val_seed: Number = 1_000_000,
        test_seed: Number = 2_000_000,
        samples_per_pixel: Count = 4,
        antialias: bool = True,
        augment: bool = True,
        cache_dir: Text | None = None,
        batch_size: int = 4,
        num_workers: int = 0,
        seed: int = 0,
        mesh: str | list[str] | None = None,
        mesh_up: Literal["y", "z"] = "y",
        mesh_scale: Positive = 1.0,
        carrier: str | None = None,
        tilts_deg: Annotated[Sequence[float], Len(2, 2)] | None = None,
    ) -> None:
        super().__init__(batch_size, num_workers, seed)
        self.rig, self.cache_dir, self.augment = rig, cache_dir, augment
        self.options: dict[str, Any] = {
            "level": level,
            "depth_level": depth_level,
            "kind": kind,
            "samples_per_pixel": samples_per_pixel,
            "antialias": antialias,
            "min_depth": min_depth,
            "meshes": None if mesh is None else mesh_files(mesh, mesh_up, mesh_scale),
            "carrier": carrier,
        }
        self.entries = None if entries is None else tuple(entries)
        self.panorama_size = panorama_size
        self.tilts = None if tilts_deg is None else tuple(math.radians(angle) for angle in tilts_deg)
        self.scenes = {
            "train": (num_train, train_seed),
            "val": (num_val, val_seed),
            "test": (num_test, test_seed),
        }
        self._check_disjoint()

    def _check_disjoint(self) -> None:
        for split, (number, first) in self.scenes.items():
            if first + number > HELD_OUT_SEED:
                raise ArgumentError(
                    f"data: seeds from {HELD_OUT_SEED} are held out for the benchmark, and {split} scenes end at "
                    f"{first + number - 1}; set data.{split}_seed to {HELD_OUT_SEED - number} or less"
                )
        ranges = sorted((first, first + number, split) for split, (number, first) in self.scenes.items())
        for (_, end, one), (start, _, other) in pairwise(ranges):
            if start < end:
                raise ArgumentError(
                    f"data: the seeds of {one} and {other} scenes overlap ({one} ends at {end - 1}, {other} "
                    f"starts at {start}); set data.{other}_seed to {end} or more"
                )

    def serve(self, net: Any, *more: str, depth_level: int | None = None) -> None:
        """Give samples that suit a network, with ``more`` entries; what the configuration says stays."""
        wanted = Wanted.by(net)
        self.entries = self.entries or tuple(dict.fromkeys((*wanted.entries, *more)))
        self.panorama_size = self.panorama_size or wanted.panorama_size
        self.options |= wanted.scale(self.options, depth_level)

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
        """Scenes of one split, as rendered.

        Raises:
            ArgumentError: the panorama cannot be turned by multiples of 72 degrees.
        """
        number, first_seed = self.scenes[split]
        entries, size = self.entries or ("sphere",), self.panorama_size or (80, 160)
        if self.augment and "panorama" in entries and size[1] % 5:
            raise ArgumentError(
                "data.panorama_size: turning by multiples of 72 degrees wants a width that is a multiple of 5, got "
                f"{size[1]}; or set data.augment=false"
            )
        chosen = self.options | {"tilts": None if split == "test" else self.tilts}
        return SceneDataset(
            number,
            self.rig,
            first_seed=first_seed,
            cache_dir=self.cache_dir,
            entries=entries,
            panorama=(int(size[0]), int(size[1])),
            **{key: value for key, value in chosen.items() if value is not None},
        )

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
