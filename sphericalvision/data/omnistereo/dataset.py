# SPDX-License-Identifier: Apache-2.0
"""The omnidirectional stereo sets (OmniThings, OmniHouse, Sunny, Cloudy, Sunset) and your own in their layout."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from torch.utils.data import Dataset

from sphericalvision.cameras import CameraRig, read_rig
from sphericalvision.core import ArgumentError, MissingFileError, check_choice
from sphericalvision.data.collate import Sample
from sphericalvision.data.omnistereo.ground_truth import read_ground_truth
from sphericalvision.data.omnistereo.releases import (
    DESCRIBED_AT,
    check_scale,
    find_release,
    index_frames,
    read_min_depth,
    split_frames,
)
from sphericalvision.io.images import read_image
from sphericalvision.sphere.intake import pixels_seen


class OmniStereoDataset(Dataset[Sample]):
    """Fisheye images, their rig and ground-truth inverse depth of one split of an omnidirectional stereo set.

    The folder holds one of two releases, which are detected and never mixed, since they differ threefold in
    scale::

        <root>/cam1 .. cam4/00001.png      RGB fisheye images; four digits are found as well as five

        PNG release                        TIFF release
        <root>/ocam1.txt .. ocam4.txt      <root>/config.yaml
        <root>/poses.txt
        <root>/depth_train_640/00001.png   <root>/omnidepth_gt_640/00001.tiff
        minimum depth 0.55 m               minimum depth 1.65 m
        rig radius 0.20 m                  rig radius 0.60 m

    Your own set needs the same layout, any number of cameras and frames, and one scale throughout.

    Each sample is a dict: ``images`` (camera name -> float32 ``(3, h, w)`` in [0, 1]), ``seen`` (camera name ->
    bool ``(h, w)``, in the field of view and in the mask), ``inverse_depth``
    (float32 ``(H, W)``, 1/m along the ray from the rig's centre, 0 is infinity; W = 2H for the full sphere,
    W = 4H for the latitudes within 45 degrees of the urban sets), ``valid`` (bool ``(H, W)``), ``rig`` and
    ``frame`` (its number as five digits); ``transform`` may make something else of it.

    Args:
        root: folder of the set.
        frames: frame numbers to take instead of a split.
        split: "train", "val" or "test" as far as the protocol has them, or "all" frames with ground truth
            in ``root``.
        protocol: whose splits: "paper" (IcoSweepNet) or "official"; see ``split_frames``.
        dataset: "omnithings", "omnihouse", "sunny", "cloudy" or "sunset", whose frames a split means.
        release: "png" or "tiff"; needed only where one folder holds both.
        min_depth: metres; by default 0.55 m for the PNG release, which does not store it, and for the TIFF
            release the value in its config.yaml, 1.65 m.
        translation_unit: of poses.txt: "cm" in the published sets, "mm" in real captures of the same group,
            or "m".
        max_angle: half the field of view in radians, for the PNG release, whose calibration lacks it; half of
            220 degrees unless given.
        missing: "error", or "skip" to go without frames of the split that are not there (a partial copy).
        transform: callable that gets each sample and returns what the data set shall return.

    Raises:
        MissingFileError: folder, calibration, ground truth or frames are missing.
        FileFormatError: releases are mixed, or a file is damaged or of the wrong size.
        ArgumentError: an unknown choice.

    References:
        Won et al., SweepNet, ICRA 2019 and OmniMVS, ICCV 2019; http://cvlab.hanyang.ac.kr/project/omnistereo

    Examples:
        >>> import torch
        >>> from sphericalvision.cameras import CameraRig, EquirectangularCamera, ring_rig
        >>> from sphericalvision.data import write_omnistereo
        >>> from sphericalvision.scenes import make_scene, render_rig
        >>> rig = CameraRig([EquirectangularCamera((8, 16))] * 2, ring_rig(2).world_from_camera)
        >>> images = render_rig(make_scene("room"), rig)
        >>> frame = {"frame": 1, "images": images, "inverse_depth": torch.ones(16, 32)}
        >>> write_omnistereo("mine", [frame], rig, release="tiff")  # stands for a set on your disk
        ['00001']
        >>> data = OmniStereoDataset("mine", split="all")
        >>> data[0]["frame"], data[0]["images"]["cam1"].shape, data[0]["inverse_depth"].shape
        ('00001', torch.Size([3, 8, 16]), torch.Size([16, 32]))
    """

    def __init__(
        self,
        root: str | Path,
        frames: Iterable[int] | None = None,
        split: str = "train",
        protocol: str = "paper",
        dataset: str = "omnithings",
        release: str | None = None,
        min_depth: float | None = None,
        translation_unit: str = "cm",
        max_angle: float | None = None,
        missing: str = "error",
        transform: Callable[[Sample], Any] | None = None,
    ) -> None:
        check_choice("missing", missing, ("error", "skip"))
        self.root = Path(root)
        self.transform = transform
        self.release = find_release(root, release)
        unit = translation_unit if self.release.name == "png" else None  # config.yaml is in metres
        calibration = self.root / self.release.calibration
        self.rig: CameraRig = read_rig(calibration, translation_unit=unit, max_angle=max_angle)
        self._seen = pixels_seen(self.rig)
        self.min_depth = self._choose_min_depth(min_depth)
        check_scale(root, self.release, self.min_depth, float(self.rig.radius))
        self._truths = index_frames(
            self.root / self.release.ground_truth_folder, "ground truth", (self.release.suffix, ".tif")
        )
        self._images = {
            name: index_frames(self.root / name, f"images of camera {name}") for name in self.rig.names
        }
        if frames is not None:
            numbers = [int(frame) for frame in frames]
        elif split == "all":
            numbers = sorted(self._truths)
        else:
            numbers = split_frames(dataset, split, protocol)
        self.frames = self._present(numbers, skip=missing == "skip")

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> Any:
        frame = self.frames[index]
        images = {
            name: read_image(files[frame], self.rig.cameras[name].image_size, f"frame {frame} of {name}")
            for name, files in self._images.items()
        }
        inverse_depth, valid = read_ground_truth(self._truths[frame], self.min_depth)
        sample: Sample = {
            "images": images,
            "seen": dict(self._seen),
            "inverse_depth": inverse_depth,
            "valid": valid,
            "rig": self.rig,
            "frame": f"{frame:05d}",
        }
        return sample if self.transform is None else self.transform(sample)

    def __repr__(self) -> str:
        return f"OmniStereoDataset({str(self.root)!r}, {len(self)} frames, {self.release})"

    def _choose_min_depth(self, min_depth: float | None) -> float:
        if min_depth is not None:
            if not 0 < min_depth < math.inf:
                raise ArgumentError(f"min_depth: expected a positive number of metres, got {min_depth!r}")
            return float(min_depth)
        config = self.root / self.release.calibration
        nearest = read_min_depth(config) if self.release.name == "tiff" else None
        return self.release.min_depth if nearest is None else nearest

    def _present(self, requested: list[int], skip: bool) -> list[int]:
        folders = {self.release.ground_truth_folder: self._truths, **self._images}
        present = [frame for frame in requested if all(frame in files for files in folders.values())]
        if present and (skip or len(present) == len(requested)):
            return present
        if not requested:
            raise MissingFileError(
                f"{(self.root / self.release.ground_truth_folder).absolute()}: no frames asked for or "
                f"found; ground truth is named 00001{self.release.suffix}. Described in {DESCRIBED_AT}."
            )
        lacking = {
            name: [frame for frame in requested if frame not in files] for name, files in folders.items()
        }
        counts = ", ".join(
            f"{name}/ lacks {len(numbers)} (first {numbers[0]:05d})"
            for name, numbers in lacking.items()
            if numbers
        )
        raise MissingFileError(
            f"{self.root.absolute()}: {len(requested) - len(present)} of the {len(requested)} frames asked for are "
            f"incomplete: {counts}. Names have four or five digits. For a partial copy use missing='skip'; "
            f"for a set of one's own use split='all' or frames=[...]. Described in {DESCRIBED_AT}."
        )
