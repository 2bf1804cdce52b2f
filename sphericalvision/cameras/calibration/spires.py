# SPDX-License-Identifier: Apache-2.0
"""Oxford Spires' ``sensor.yaml``: the cameras of an Alphasense with poses to the LiDAR.

Convention:
    ``T_cam_lidar_t_xyz_q_xyzw`` is a translation in metres and a quaternion (x, y, z, w), LiDAR to camera; the LiDAR is
    the rig's world. ``camera_fov`` is the full angle in degrees.

References:
    Y. Tao et al., "The Oxford Spires dataset", IJRR 44 (2025), and its repository's ``config/sensor.yaml``.
"""

from __future__ import annotations

from typing import Any

from sphericalvision.cameras.calibration.contents import Calibration
from sphericalvision.cameras.calibration.formats import FileFormat
from sphericalvision.cameras.calibration.keys import Keys
from sphericalvision.cameras.calibration.lenses import distorted
from sphericalvision.cameras.calibration.poses import transform_from_numbers
from sphericalvision.geometry import invert_transform

_MODELS = {"PINHOLE": "none", "OPENCV": "radtan", "OPENCV_FISHEYE": "equidistant"}


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file has a ``sensor`` with cameras."""
    sensor = content.get("sensor")
    return isinstance(sensor, dict) and "cameras" in sensor


def read(content: Keys, calibration: Calibration) -> None:
    """Cameras by label and poses of a parsed file."""
    sensor, key = content.inner("sensor"), "T_cam_lidar_t_xyz_q_xyzw"
    model = _MODELS[sensor.chosen("camera_model", _MODELS)]
    view = sensor.half_view("camera_fov")
    for values in sensor.several("cameras"):
        numbers = values.numbers("intrinsics", 4)
        if values.entry("extra_params"):
            numbers += values.numbers("extra_params")
        size = values.size("image_width", "image_height")
        x, y, z, *turn = values.numbers(key, 7)
        pose = transform_from_numbers([turn[3], *turn[:3]], [x, y, z], values.at(key))
        camera = distorted(model, numbers, size, values.at("extra_params"))
        calibration.add(str(values.entry("label")), camera, values.where, invert_transform(pose), view)


FileFormat(
    "spires",
    "Oxford Spires sensor.yaml",
    recognizes_keys=recognizes,
    read_keys=read,
    ignored=r"sensor/(max_time_\w+|T_base_\w+|tf_\w+)|sensor/cameras/(topic|T_cam_imu_\w+)",
).register()
