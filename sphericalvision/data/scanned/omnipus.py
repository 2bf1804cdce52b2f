# SPDX-License-Identifier: Apache-2.0
"""OmniPus: four fisheyes of 180° and an Ouster LiDAR; ``data=omnipus``."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, KannalaBrandtCamera
from sphericalvision.cameras.calibration.text_files import load
from sphericalvision.core import FileFormatError, check_choice, check_file
from sphericalvision.data.scanned.scanned_frames import Sample, ScannedFrames, read_raster
from sphericalvision.data.scanned.spires import OURS_FROM_LIDAR
from sphericalvision.geometry import transform_from_axis_angle
from sphericalvision.io.files import by_numbers
from sphericalvision.io.images import read_mask
from sphericalvision.sphere import Equirectangular

TEST_CASES = {"a": (1, 8, 9, 10, 14), "b": (6, 8, 9, 11), "c": (1, 4)}
CASES = {"a": 15, "b": 13, "c": 5}
TRUTH_SIZE = (160, 640)
"""Rows, columns; pixels are square, so the rows are those within 45° of the horizon."""


class OmniPusDataset(ScannedFrames):
    """Frames of OmniPus by its official test cases; what is not for the test is for training.

    ``root/calibration/cam{1..4}.yaml`` and ``cam%d_mask.png``, and ``root/omnipus{a,b,c}/omnipusX_caseN`` with
    ``resize_cam%d/%06d.png`` and ``omnidepth_gt/%06d.tiff``, inverse depth in 1/m around the rig's centre.

    Args:
        split: "train" or "test".

    Raises:
        FileFormatError: a calibration that lacks a number.
    """

    def __init__(
        self,
        root: str | Path,
        split: str = "train",
        height: int = 160,
        transform: Callable[[Sample], Any] | None = None,
    ) -> None:
        super().__init__(root, height, transform)
        check_choice("split", split, ("train", "test"))
        folder = self.root / "calibration"
        calibrations = [_camera(folder / f"cam{k}.yaml") for k in (1, 2, 3, 4)]
        cameras = {f"cam{k}": camera for k, (camera, _) in enumerate(calibrations, 1)}
        poses = torch.stack([OURS_FROM_LIDAR @ pose for _, pose in calibrations])
        masks = {name: folder / f"{name}_mask.png" for name in cameras}
        self.fixed_rig = CameraRig(
            cameras, poses, {n: read_mask(m, cameras[n].image_size) for n, m in masks.items() if m.is_file()}
        )
        self.truth = Equirectangular.with_square_pixels(*TRUTH_SIZE)
        cases = (
            self.root / f"omnipus{part}" / f"omnipus{part.upper()}_case{case}"
            for part, tests in TEST_CASES.items()
            for case in range(1, CASES[part] + 1)
            if (case in tests) == (split == "test")
        )
        frames = (
            (
                f"{case.parent.name}/{case.name}/{truth.stem}",
                {camera: case / f"resize_{camera}" / f"{truth.stem}.png" for camera in cameras},
                truth,
            )
            for case in cases
            for truth in sorted((case / "omnidepth_gt").glob("*.tiff"), key=by_numbers)
        )
        self.take(frames, "omnipus{a,b,c}/omnipusX_caseN with images and omnidepth_gt")

    def points(self, name: str) -> Tensor:
        """Points of the map of inverse depth around the rig's centre."""
        inverse_depth = read_raster(self.truths[name], 1.0, TRUTH_SIZE, "inverse depth")
        valid = inverse_depth.isfinite() & (inverse_depth > 0)
        return self.truth.directions[valid] / inverse_depth[valid][:, None] + self.fixed_rig.center


def _camera(path: Path) -> tuple[KannalaBrandtCamera, Tensor]:
    """A camera and its pose in the LiDAR's frame, from lists of mappings with one key each."""
    content = load(check_file(path, "OmniPus's calibration of a camera"))
    try:
        flat = {
            key: {
                name: float(value) for entry in content[f"{key}_parameters"] for name, value in entry.items()
            }
            for key in ("intrinsic", "distortion", "extrinsic")
        }
        fx, fy, cx, cy = (flat["intrinsic"][name] for name in ("fx", "fy", "cx", "cy"))
        coefficients = [flat["distortion"][f"k{k}"] for k in (1, 2, 3, 4)]
        pose = [flat["extrinsic"][name] for name in ("roll", "pitch", "yaw", "x", "y", "z")]
        size = int(content["image_height"]), int(content["image_width"])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise FileFormatError(f"{path}: not as OmniPus has it ({error!r:.100})") from error
    camera = KannalaBrandtCamera([fx, fy], [cx, cy], coefficients, size, max_angle=math.pi / 2)
    rotations = [transform_from_axis_angle(pose[k] * torch.eye(3)[k], torch.zeros(3)) for k in range(3)]
    lidar_from_camera = rotations[2] @ rotations[1] @ rotations[0]
    lidar_from_camera[:3, 3] = torch.tensor(pose[3:])
    return camera, lidar_from_camera
