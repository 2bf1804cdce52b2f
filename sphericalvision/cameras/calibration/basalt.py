# SPDX-License-Identifier: Apache-2.0
"""Basalt's calibration json: double sphere, (extended) unified, Kannala-Brandt and pinhole cameras; metres.

Convention:
    ``T_imu_cam`` is a quaternion (qx, qy, qz, qw) and a position, camera to IMU; the IMU's frame is the rig's world.
    Cameras are ``cam0``, ``cam1``, ... A file ``cam0/mask.png`` beside it, white where pixels are usable, is its mask.
    ``pinhole-radtan8`` is OpenCV's rational model; its ``rpmax``, unless 0, is the largest undistorted radius.
    Basalt's ``ucm`` has α = ξ / (1 + ξ) and focal lengths f = γ / (1 + ξ).
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Contents, Options
from sphericalvision.cameras.calibration.files import write_json
from sphericalvision.cameras.calibration.formats import FileFormat, register_format
from sphericalvision.cameras.calibration.lenses import (
    Lens,
    as_rig,
    lens_called,
    lens_of,
    models_of,
    numbers_of,
)
from sphericalvision.cameras.calibration.parsing import (
    chosen,
    entry,
    focal_lengths,
    mapping,
    number,
    size_from_width_height,
)
from sphericalvision.cameras.calibration.poses import quaternion_from_rotation, transform_from_numbers
from sphericalvision.cameras.calibration.visible_part import bounded
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import FileFormatError
from sphericalvision.io.images import read_mask, write_mask

__all__ = ["contents", "recognizes", "write_basalt"]

_LENSES = (
    Lens("ds", "double_sphere", "fx fy cx cy xi alpha"),
    Lens("eucm", "extended_unified", "fx fy cx cy alpha beta"),
    Lens("ucm", "unified", "fx fy cx cy alpha=xi"),
    Lens("kb4", "kannala_brandt", "fx fy cx cy k1 k2 k3 k4"),
    Lens("pinhole", "pinhole", "fx fy cx cy"),
    Lens("fov", "atan", "fx fy cx cy w=omega"),
    Lens("pinhole-radtan8", "brown_conrady", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6 rpmax"),
)
_POSITION, _QUATERNION = ("px", "py", "pz"), ("qw", "qx", "qy", "qz")


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file has ``value0``, as everything that Basalt writes."""
    return "value0" in content


def contents(content: Any, path: Path, options: Options) -> Contents:
    """Cameras, poses and masks of a parsed file."""
    value0 = entry(content, "value0", str(path))
    needed = ["intrinsics", "resolution"]
    if options.rig or "T_imu_cam" in mapping(value0, f"{path}, value0"):
        needed.append("T_imu_cam")
    parts = {key: entry(value0, key, f"{path}, value0") for key in needed}
    for key, values in parts.items():
        if not isinstance(values, list) or not values:
            raise FileFormatError(f"{path}, value0, {key}: expected a list of at least one entry")
    count = len(parts["intrinsics"])
    for key, values in parts.items():
        if len(values) != count:
            raise FileFormatError(
                f"{path}: {key} holds {len(values)} cameras and intrinsics {count}; one entry for each camera expected"
            )
    cameras, poses, masks = {}, [], {}
    for index in range(count):
        name, where = f"cam{index}", f"{path}, camera {index}"
        size = size_from_width_height(parts["resolution"][index], f"{where}, resolution")
        camera = _camera(parts["intrinsics"][index], size, where)
        mask_path = path.parent / name / "mask.png"
        if mask_path.is_file():
            masks[name] = read_mask(mask_path, size)
        cameras[name] = bounded(camera, options.max_angle, where, masks.get(name))
        if "T_imu_cam" not in parts:
            continue
        where = f"{where}, T_imu_cam"
        pose = [number(parts["T_imu_cam"][index], key, where) for key in (*_QUATERNION, *_POSITION)]
        poses.append(transform_from_numbers(pose[:4], pose[4:], where))
    return Contents(cameras, torch.stack(poses) if poses else None, masks)


def _camera(values: Any, image_size: tuple[int, int], where: str) -> Camera:
    kinds = [lens.name for lens in _LENSES]
    lens = lens_called(_LENSES, chosen(entry(values, "camera_type", where), kinds, f"{where}, camera_type"))
    intrinsics = entry(values, "intrinsics", where)
    found = [number(intrinsics, key, where) for key in lens.keys]
    max_angle = None
    if lens.name == "ucm":
        fx, fy, *center, alpha = found
        focal_lengths([fx, fy], f"{where}, fx and fy")
        if not 0 <= alpha < 1:
            raise FileFormatError(f"{where}, alpha: expected a number in [0, 1), got {alpha:g}")
        xi = alpha / (1 - alpha)
        found = [fx * (1 + xi), fy * (1 + xi), *center, xi]
    elif lens.name == "pinhole-radtan8" and found[-1] > 0:
        max_angle = math.atan(found[-1])
    return lens.camera(found, image_size, where, max_angle)


def write_basalt(cameras: Camera | CameraRig, path: str | Path) -> None:
    """Write a camera or a rig as Basalt's json, and masks as ``cam0/mask.png``, ... beside it.

    Cameras become ``cam0``, ``cam1``, ... in their order. Only cameras are written: Basalt itself wants to find the
    IMU's calibration in the file, too. Fields of view are not part of the format.

    Raises:
        ArgumentError: Basalt has no such model; the message names formats that have it.
    """
    path = Path(path)
    rig = as_rig(cameras)
    value0: dict[str, list[Any]] = {"T_imu_cam": [], "intrinsics": [], "resolution": []}
    for camera, pose in zip(rig.cameras.values(), rig.world_from_camera, strict=True):
        lens, found = _values(camera)
        value0["intrinsics"].append(
            {"camera_type": lens.name, "intrinsics": dict(zip(lens.keys, found, strict=True))}
        )
        value0["resolution"].append(list(camera.image_size[::-1]))
        rotation = quaternion_from_rotation(pose[:3, :3])
        value0["T_imu_cam"].append(
            {
                **dict(zip(_POSITION, numbers_of(pose[:3, 3]), strict=True)),
                **dict(zip(_QUATERNION, rotation, strict=True)),
            }
        )
    for index, name in enumerate(rig.names):
        if name in rig.masks:
            folder = path.parent / f"cam{index}"
            folder.mkdir(exist_ok=True)
            write_mask(folder / "mask.png", rig.masks[name])
    write_json(path, {"value0": value0})


def _values(camera: Camera) -> tuple[Lens, list[float]]:
    """The lens and its numbers."""
    lens, found = lens_of(camera, _LENSES, "basalt")
    if lens.name == "ucm":
        fx, fy, *center, xi = found
        found = [fx / (1 + xi), fy / (1 + xi), *center, xi / (1 + xi)]
    return lens, found


register_format(
    FileFormat(
        "basalt",
        "Basalt json",
        recognizes_keys=recognizes,
        contents_of_keys=contents,
        ignored=r"value0/(\w*(accel|gyro|imu_update|mocap|marker|vignette)\w*|cam_time_offset_ns|view_offset)|value\d/cereal\w*",
        usual_names=("calibration.json",),
        models=models_of(_LENSES),
        write_camera=write_basalt,
        write_rig=write_basalt,
        holds_masks=True,
    )
)
