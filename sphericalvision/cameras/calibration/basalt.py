# SPDX-License-Identifier: Apache-2.0
"""Basalt's calibration json: double sphere, Kannala-Brandt (kb4) and pinhole cameras, poses in metres."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import torch

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.numbers import check_radius, entry, numbers, read_mask, widest_angle
from sphericalvision.cameras.double_sphere import DoubleSphereCamera
from sphericalvision.cameras.kannala_brandt import KannalaBrandtCamera
from sphericalvision.cameras.pinhole import PinholeCamera
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import ArgumentError, FileFormatError, check_file
from sphericalvision.geometry import transform_from_quaternion

__all__ = ["read_basalt"]


def read_basalt(
    path: str | Path, *, max_angle: float | None = None, dtype: torch.dtype | None = None
) -> CameraRig:
    """The rig of a Basalt json; cameras are ``cam0``, ``cam1``, ...; the world is the file's IMU frame.

    A file ``cam0/mask.png`` beside it, white where pixels are usable, becomes the camera's mask.

    Args:
        path: the file.
        max_angle: half the field of view in radians, which the file does not tell; by default the angle at the
            farthest pixel of each image, within the mask if there is one.
        dtype: of intrinsics and poses, by default torch's default.

    Raises:
        MissingFileError: there is no such file.
        FileFormatError: the file is not such a json, or of a camera type that is not supported yet.
    """
    path = check_file(path, "a Basalt calibration json")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise FileFormatError(f"{path}: not valid json ({error}); is it truncated?") from None
    value0 = entry(content, "value0", str(path))
    parts = {key: entry(value0, key, f"{path}, value0") for key in ("T_imu_cam", "intrinsics", "resolution")}
    for key, values in parts.items():
        if not isinstance(values, list) or not values:
            raise FileFormatError(f"{path}, value0, {key}: expected a list of at least one entry")
    count = len(parts["intrinsics"])
    for key, values in parts.items():
        if len(values) != count:
            raise FileFormatError(
                f"{path}: {key} holds {len(values)} cameras and intrinsics {count}; one entry for each camera expected"
            )
    dtype = dtype or torch.get_default_dtype()
    cameras, poses, masks = {}, [], {}
    for index in range(count):
        name, where = f"cam{index}", f"{path}, camera {index}"
        width, height = numbers(parts["resolution"][index], f"{where}, resolution", 2)
        camera = _camera(parts["intrinsics"][index], (int(height), int(width)), where)
        mask_path = path.parent / name / "mask.png"
        if mask_path.is_file():
            masks[name] = read_mask(mask_path, camera.image_size)
        angle = widest_angle(camera, masks.get(name)) if max_angle is None else max_angle
        cameras[name] = camera.with_max_angle(min(angle, float(camera.max_angle))).to(dtype)
        poses.append(_pose(parts["T_imu_cam"][index], f"{where}, T_imu_cam"))
    table = torch.tensor(poses, dtype=torch.float64)
    world_from_camera = transform_from_quaternion(table[:, :4], table[:, 4:]).to(dtype)
    return check_radius(CameraRig(cameras, world_from_camera, masks), path)


def _pose(values: Any, where: str) -> list[float]:
    """qw qx qy qz px py pz."""
    return [
        numbers(entry(values, key, where), f"{where}, {key}", 1)[0]
        for key in ("qw", "qx", "qy", "qz", "px", "py", "pz")
    ]


def _camera(values: Any, image_size: tuple[int, int], where: str) -> Camera:
    kind = entry(values, "camera_type", where)
    intrinsics = entry(values, "intrinsics", where)

    def get(*keys: str) -> torch.Tensor:
        found = [numbers(entry(intrinsics, key, where), f"{where}, {key}", 1)[0] for key in keys]
        return torch.tensor(found, dtype=torch.float64)

    if kind not in ("ds", "kb4", "pinhole"):
        raise FileFormatError(
            f"{where}: the camera type {kind!r} is not supported yet; supported are ds (double sphere), "
            "kb4 (Kannala-Brandt) and pinhole"
        )
    focal_length, center = get("fx", "fy"), get("cx", "cy")
    try:
        if kind == "ds":
            xi, alpha = get("xi", "alpha")
            return DoubleSphereCamera(focal_length, center, xi, alpha, image_size, math.pi)
        if kind == "kb4":
            distortion = get("k1", "k2", "k3", "k4")
            return KannalaBrandtCamera(focal_length, center, distortion, image_size, math.pi)
        return PinholeCamera(focal_length, center, image_size)
    except ArgumentError as error:
        raise FileFormatError(f"{where}: {error}") from None
