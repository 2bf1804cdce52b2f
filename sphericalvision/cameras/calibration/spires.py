# SPDX-License-Identifier: Apache-2.0
"""Oxford Spires' ``sensor.yaml``: the cameras of an Alphasense with poses to the LiDAR.

Convention:
    ``T_cam_lidar_t_xyz_q_xyzw`` is a translation in metres and a quaternion (x, y, z, w), LiDAR to camera; the LiDAR is
    the rig's world. ``camera_fov`` is the full angle in degrees.

References:
    Y. Tao et al., "The Oxford Spires dataset", IJRR 44 (2025), and its repository's ``config/sensor.yaml``.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Contents, Options
from sphericalvision.cameras.calibration.formats import FileFormat, register_format
from sphericalvision.cameras.calibration.lenses import distorted
from sphericalvision.cameras.calibration.parsing import chosen, entry, number, numbers, size_from_width_height
from sphericalvision.cameras.calibration.poses import transform_from_numbers
from sphericalvision.cameras.calibration.visible_part import bounded
from sphericalvision.core import FileFormatError
from sphericalvision.geometry import invert_transform

__all__ = ["contents", "recognizes"]

_MODELS = {"PINHOLE": "none", "OPENCV": "radtan", "OPENCV_FISHEYE": "equidistant"}


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file has a ``sensor`` with cameras."""
    sensor = content.get("sensor")
    return isinstance(sensor, dict) and "cameras" in sensor


def contents(content: dict[str, Any], path: Path, options: Options) -> Contents:
    """Cameras by label and poses of a parsed file."""
    sensor, key = content["sensor"], "T_cam_lidar_t_xyz_q_xyzw"
    model = _MODELS[chosen(entry(sensor, "camera_model", str(path)), _MODELS, f"{path}, camera_model")]
    view = math.radians(number(sensor, "camera_fov", str(path))) / 2 if "camera_fov" in sensor else None
    if not isinstance(sensor["cameras"], list) or not sensor["cameras"]:
        raise FileFormatError(f"{path}, sensor, cameras: expected a list of at least one camera")
    cameras: dict[str, Camera] = {}
    poses = []
    for index, values in enumerate(sensor["cameras"]):
        where = f"{path}, sensor, cameras[{index}]"
        name = str(entry(values, "label", where))
        if name in cameras:
            raise FileFormatError(f"{where}, label: expected a name of its own, got {name!r:.80}")
        found = numbers(entry(values, "intrinsics", where), f"{where}, intrinsics", 4)
        more = entry(values, "extra_params", where)
        found += numbers(more, f"{where}, extra_params") if more else []
        size = size_from_width_height(
            [entry(values, f"image_{side}", where) for side in ("width", "height")], where
        )
        camera = distorted(model, found, size, f"{where}, extra_params")
        cameras[name] = bounded(camera, options.max_angle or view, where)
        x, y, z, *turn = numbers(entry(values, key, where), f"{where}, {key}", 7)
        poses.append(
            invert_transform(transform_from_numbers([turn[3], *turn[:3]], [x, y, z], f"{where}, {key}"))
        )
    return Contents(cameras, torch.stack(poses))


register_format(
    FileFormat(
        "spires",
        "Oxford Spires sensor.yaml",
        recognizes_keys=recognizes,
        contents_of_keys=contents,
        ignored=r"sensor/(max_time_\w+|T_base_\w+|tf_\w+)|sensor/cameras/(topic|T_cam_imu_\w+)",
    )
)
