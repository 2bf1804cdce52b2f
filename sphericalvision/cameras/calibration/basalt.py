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

from torch import Tensor

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Calibration
from sphericalvision.cameras.calibration.formats import FileFormat, has_all
from sphericalvision.cameras.calibration.keys import Keys
from sphericalvision.cameras.calibration.lenses import (
    Lens,
    as_rig,
    check_targets,
    lens_called,
    lens_of,
    models_of,
    numbers_of,
)
from sphericalvision.cameras.calibration.parsing import size_from_width_height
from sphericalvision.cameras.calibration.poses import quaternion_from_rotation, transform_from_numbers
from sphericalvision.cameras.calibration.text_files import write_json
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import FileFormatError
from sphericalvision.io.images import read_mask, write_mask

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


def read(content: Keys, calibration: Calibration) -> None:
    """Cameras, poses and masks of a parsed file."""
    value0 = content.inner("value0")
    lenses = value0.several("intrinsics")
    poses = value0.several("T_imu_cam") if calibration.options.rig or "T_imu_cam" in value0 else []
    sizes = value0.entry("resolution")
    for key, values in (("T_imu_cam", poses or lenses), ("resolution", sizes)):
        if not isinstance(values, list) or len(values) != len(lenses):
            count = len(values) if isinstance(values, list) else "no list of"
            raise FileFormatError(
                f"{value0.at(key)}: holds {count} cameras and intrinsics {len(lenses)}; one entry for each camera "
                "expected"
            )
    for index, values in enumerate(lenses):
        size = size_from_width_height(sizes[index], f"{value0.at('resolution')}[{index}]")
        mask_path = calibration.path.parent / f"cam{index}" / "mask.png"
        mask = read_mask(mask_path, size) if mask_path.is_file() else None
        pose = _pose(poses[index]) if poses else None
        calibration.add(f"cam{index}", _camera(values, size), values.where, pose, mask=mask)


def _pose(values: Keys) -> Tensor:
    quaternion, place = ([values.number(key) for key in keys] for keys in (_QUATERNION, _POSITION))
    return transform_from_numbers(quaternion, place, values.where)


def _camera(values: Keys, image_size: tuple[int, int]) -> Camera:
    lens = lens_called(_LENSES, values.chosen("camera_type", [lens.name for lens in _LENSES]))
    intrinsics = values.inner("intrinsics")
    parameters = [intrinsics.number(key) for key in lens.keys]
    max_angle = math.atan(parameters[-1]) if lens.name == "pinhole-radtan8" and parameters[-1] > 0 else None
    return lens.camera(parameters, image_size, intrinsics.where, max_angle)


def write_basalt(cameras: Camera | CameraRig, path: str | Path) -> None:
    """Write a camera or a rig as Basalt's json, and masks as ``cam0/mask.png``, ... beside it.

    Cameras become ``cam0``, ``cam1``, ... in their order. Only cameras are written: Basalt itself wants to find the
    IMU's calibration in the file, too. Fields of view are not part of the format.
    """
    path = Path(path)
    rig = as_rig(cameras)
    masks = {name: path.parent / f"cam{index}" / "mask.png" for index, name in enumerate(rig.names)}
    check_targets(path, masks, rig)
    value0: dict[str, list[Any]] = {"T_imu_cam": [], "intrinsics": [], "resolution": []}
    for camera, pose in zip(rig.cameras.values(), rig.world_from_camera, strict=True):
        lens, parameters = lens_of(camera, _LENSES, "basalt")
        value0["intrinsics"].append(
            {"camera_type": lens.name, "intrinsics": dict(zip(lens.keys, parameters, strict=True))}
        )
        value0["resolution"].append(list(camera.image_size[::-1]))
        position, quaternion = numbers_of(pose[:3, 3]), quaternion_from_rotation(pose[:3, :3])
        keys = (*_POSITION, *_QUATERNION)
        value0["T_imu_cam"].append(dict(zip(keys, position + quaternion, strict=True)))
    for name, mask in rig.masks.items():
        write_mask(masks[name], mask)
    write_json(path, {"value0": value0})


FileFormat(
    "basalt",
    "Basalt json",
    recognizes_keys=has_all("value0"),
    read_keys=read,
    ignored=r"value0/(\w*(accel|gyro|imu_update|mocap|marker|vignette)\w*|cam_time_offset_ns|view_offset)|value\d/cereal\w*",
    usual_names=("calibration.json",),
    models=models_of(_LENSES),
    write_camera=write_basalt,
    write_rig=write_basalt,
    holds_masks=True,
).register()
