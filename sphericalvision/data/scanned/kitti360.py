# SPDX-License-Identifier: Apache-2.0
"""KITTI-360: fisheyes to the left and to the right of a car, and a Velodyne; ``data=kitti360``.

At one moment the two fisheyes see almost nothing twice, so a frame here is a window over time: both at several poses.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras import CameraRig, Trajectory, read_camera, read_trajectory
from sphericalvision.cameras.calibration.parsing import numbers
from sphericalvision.cameras.calibration.poses import transform_from_rows
from sphericalvision.cameras.calibration.text_files import data_lines
from sphericalvision.core import FileFormatError, MissingFileError, check_file
from sphericalvision.data.point_files import read_points
from sphericalvision.data.scanned.scanned_frames import Sample, ScannedFrames
from sphericalvision.geometry import invert_transform, transform_from_axis_angle, transform_points
from sphericalvision.geometry.transforms import axis_angle_from_transform

FISHEYES = ("image_02", "image_03")


class Kitti360Dataset(ScannedFrames):
    """Windows of KITTI-360: both fisheyes at several poses, and the scan at the middle one.

    A rig's cameras are called ``image_02-0``, ``image_03-0``, ``image_02-1``, ...; its world is the vehicle at the
    middle pose, turned so that y points down. Points are moved to where they are seen from the scanner as it looks
    forward, which is the time of the pose; see ``at_one_time``.

    Args:
        root: folder with ``calibration``, ``data_2d_raw``, ``data_3d_raw`` and ``data_poses``.
        sequences: names such as ``2013_05_28_drive_0000_sync``.
        window: poses of a window.
        spacing: metres between them.

    References:
        Y. Liao, J. Xie, A. Geiger, "KITTI-360", PAMI 45 (2023).
    """

    def __init__(
        self,
        root: str | Path,
        sequences: Sequence[str],
        window: int = 3,
        spacing: float = 1.0,
        height: int = 160,
        transform: Callable[[Sample], Any] | None = None,
    ) -> None:
        super().__init__(root, height, transform)
        folder = self.root / "calibration"
        self.cameras = {name: read_camera(folder / f"{name}.yaml") for name in FISHEYES}
        poses = _named_transforms(folder / "calib_cam_to_pose.txt")
        if lacking := [name for name in ("image_00", *FISHEYES) if name not in poses]:
            raise FileFormatError(f"{folder / 'calib_cam_to_pose.txt'}: no line begins with {lacking[0]}:")
        _, words = data_lines(check_file(folder / "calib_cam_to_velo.txt", "KITTI-360's calibration"))[0]
        velo_from_cam = transform_from_rows(numbers(words, str(folder / "calib_cam_to_velo.txt"), 12), "velo")
        self.pose_from_cam = {name: poses[name] for name in FISHEYES}
        self.pose_from_velo = poses["image_00"] @ invert_transform(velo_from_cam)
        # The vehicle has x forward, y to the right and z down; ours is x right, y down, z forward.
        axes = [[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
        self.ours_from_pose = torch.tensor(axes, dtype=torch.float64)
        self._poses: dict[str, Tensor] = {}
        self._motions: dict[str, tuple[Tensor, Tensor]] = {}
        windows = (frame for sequence in sequences for frame in self._windows(sequence, window, spacing))
        self.take(windows, "images, scans and poses of one sequence or more")

    def _windows(
        self, sequence: str, window: int, spacing: float
    ) -> Iterator[tuple[str, dict[str, Path], Path]]:
        """Name, images and scan of the windows of a sequence, whose poses and motions are kept."""
        trajectory = read_trajectory(self.root / "data_poses" / sequence / "poses.txt")
        numbers_of = [int(name) for name in trajectory.names]
        for chosen in trajectory.windows(window, spacing):
            frames = [numbers_of[k] for k in chosen]
            center = chosen[len(chosen) // 2]
            name = f"{sequence}/{numbers_of[center]:010d}"
            world_from_pose = trajectory.world_from_camera.double()
            self._poses[name] = invert_transform(world_from_pose[center]) @ world_from_pose[chosen]
            self._motions[name] = self._motion(trajectory, numbers_of, center)
            raw = self.root / "data_2d_raw" / sequence
            images = {
                f"{camera}-{k}": raw / camera / "data_rgb" / f"{frame:010d}.png"
                for k, frame in enumerate(frames)
                for camera in FISHEYES
            }
            scans = self.root / "data_3d_raw" / sequence / "velodyne_points" / "data"
            yield name, images, scans / f"{numbers_of[center]:010d}.bin"

    def rig(self, name: str) -> CameraRig:
        """Both fisheyes at all poses of the window."""
        middle_from_pose = self._poses[name]
        poses = [
            self.ours_from_pose @ pose @ p for pose in middle_from_pose for p in self.pose_from_cam.values()
        ]
        cameras = {
            f"{c}-{k}": camera for k in range(len(middle_from_pose)) for c, camera in self.cameras.items()
        }
        return CameraRig(cameras, torch.stack(poses).float())

    def points(self, name: str) -> Tensor:
        """Of the middle pose."""
        points = at_one_time(read_points(self.truths[name]), *self._motions[name])
        return transform_points((self.ours_from_pose @ self.pose_from_velo).float(), points)

    def _motion(self, trajectory: Trajectory, frames: Sequence[int], row: int) -> tuple[Tensor, Tensor]:
        """Of the scanner in a turn: from the pose before, and how many turns that is away."""
        before, now = trajectory.world_from_camera[row - 1 : row + 1].double() @ self.pose_from_velo
        motion = axis_angle_from_transform(invert_transform(now) @ before)
        step = frames[row] - frames[row - 1]
        return motion[0].float() / step, motion[1].float() / step


def at_one_time(
    points: Float[Tensor, "P 3"], rotation: Float[Tensor, " 3"], translation: Float[Tensor, " 3"]
) -> Float[Tensor, "P 3"]:
    """Points of a turn of a moving scanner, as it would have measured them all while it looked forward.

    It turns from the back over the left, the front (x) and the right to the back, so that an azimuth is a time: what
    is to the left (y) was measured before, what is to the right after. Motion is taken as even.

    Args:
        points: ``(P, 3)`` metres, in the scanner's frame: x forward, y left, z up.
        rotation: ``(3,)`` rotation vector in radians of *this turn's frame from the last turn's*.
        translation: ``(3,)`` of the same transform, metres.

    References:
        https://github.com/autonomousvision/kitti360Scripts, whose viewer moves points by this rule since 2023.

    Examples:
        >>> forward = torch.tensor([-1.0, 0.0, 0.0])  # a metre a turn: what was ahead is nearer
        >>> at_one_time(torch.tensor([[0.0, 8.0, 0.0], [8.0, 0.0, 0.0]]), torch.zeros(3), forward)
        tensor([[-0.2500,  8.0000,  0.0000],
                [ 8.0000,  0.0000,  0.0000]])
    """
    fraction = torch.atan2(points[:, 1], points[:, 0])[:, None] / (2 * math.pi)
    moved = transform_from_axis_angle(fraction * rotation, fraction * translation)
    return transform_points(moved, points[:, None])[:, 0]


def _named_transforms(path: Path) -> dict[str, Tensor]:
    transforms = {}
    for line, (label, *words) in data_lines(check_file(path, "KITTI-360's calibration")):
        where = f"{path}, line {line}"
        transforms[label.rstrip(":")] = transform_from_rows(numbers(words, where, 12), where)
    if not transforms:
        raise MissingFileError(f"{path}: no transform in it")
    return transforms
