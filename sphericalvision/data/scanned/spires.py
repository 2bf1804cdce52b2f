# SPDX-License-Identifier: Apache-2.0
"""Oxford Spires: three fisheyes to the front and the sides, and a LiDAR; ``data=spires``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, read_rig
from sphericalvision.core import MissingFileError
from sphericalvision.data.point_files import read_points
from sphericalvision.data.scanned.scanned_frames import Sample, ScannedFrames
from sphericalvision.geometry import transform_points
from sphericalvision.io.files import by_numbers
from sphericalvision.io.times import SAME_TIME, nearest_in_time, seconds

OURS_FROM_LIDAR = torch.tensor(
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""From x forward, y left, z up to x right, y down, z forward."""


class SpiresDataset(ScannedFrames):
    """Frames of Oxford Spires whose LiDAR cloud and images were taken at one time.

    ``root/sequences/<name>/raw/cam{0,1,2}/<sec>.<nsec>.jpg`` and
    ``processed/vilens-slam/undist-clouds/cloud_<sec>_<nsec>.pcd``, with ``root/sensor.yaml``. Clouds are in the
    frame of the LiDAR.

    Args:
        sequences: names of folders in ``sequences``.
        tolerance: seconds between images and cloud, at most; others are left out and counted.

    References:
        Y. Tao et al., "The Oxford Spires dataset", IJRR 44 (2025).
    """

    def __init__(
        self,
        root: str | Path,
        sequences: Sequence[str],
        height: int = 160,
        transform: Callable[[Sample], Any] | None = None,
        tolerance: float = SAME_TIME,
    ) -> None:
        super().__init__(root, height, transform)
        lidar = read_rig(self.root / "sensor.yaml")
        cameras = {f"cam{k}": camera for k, camera in enumerate(lidar.cameras.values())}
        self.fixed_rig = CameraRig(cameras, OURS_FROM_LIDAR @ lidar.world_from_camera.float())
        self.images: dict[str, dict[str, Path]] = {}
        lacking: dict[str, str] = {}
        for sequence in sequences:
            self._add(sequence, tolerance, lacking)
        self.names = self.complete(
            list(self.images), lacking, f"clouds, and images at most {tolerance:g} s away"
        )

    def _add(self, sequence: str, tolerance: float, lacking: dict[str, str]) -> None:
        folder = self.root / "sequences" / sequence
        scans = folder / "processed" / "vilens-slam" / "undist-clouds"
        clouds = sorted(scans.glob("cloud_*.pcd"), key=by_numbers)
        if not clouds:
            raise MissingFileError(
                f"{scans.absolute()}: expected cloud_<sec>_<nsec>.pcd of {sequence}, got none"
            )
        times = seconds([cloud.stem for cloud in clouds])
        names = [f"{sequence}/{cloud.stem}" for cloud in clouds]
        self.images |= {name: {} for name in names}
        for camera in self.fixed_rig.names:
            files = sorted((folder / "raw" / camera).glob("*.jpg"))
            nearest = nearest_in_time(times, seconds([file.stem for file in files]), tolerance)
            for name, place in zip(names, nearest, strict=True):
                if place is not None:
                    self.images[name][camera] = files[place]
        for name in names:
            missing = [camera for camera in self.fixed_rig.names if camera not in self.images[name]]
            if missing:
                lacking[name] = f"an image of {missing[0]} at its time"

    def points(self, name: str) -> Tensor:
        """Of the cloud."""
        sequence, cloud = name.split("/")
        folder = self.root / "sequences" / sequence / "processed" / "vilens-slam" / "undist-clouds"
        # Clouds of this set are in the frame of the LiDAR; VIEWPOINT is the pose of the LiDAR in the world.
        points = read_points(folder / f"{cloud}.pcd", ignore_viewpoint=True)
        return transform_points(OURS_FROM_LIDAR, points.float())
