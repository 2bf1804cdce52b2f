# SPDX-License-Identifier: Apache-2.0
"""OKVIS's and OKVIS2's configuration: a list of cameras with poses, among settings of the program.

Convention:
    ``T_SC`` takes coordinates of the camera to the sensor's, which is the IMU and the rig's world; metres. Cameras are
    ``cam0``, ``cam1``, ... in the order of the list.

References:
    S. Leutenegger et al., "Keyframe-based visual-inertial odometry using nonlinear optimization", IJRR 34 (2015).
"""

from __future__ import annotations

from typing import Any

from sphericalvision.cameras.calibration.contents import Calibration
from sphericalvision.cameras.calibration.formats import FileFormat
from sphericalvision.cameras.calibration.keys import SETTINGS, Keys
from sphericalvision.cameras.calibration.lenses import distorted
from sphericalvision.cameras.calibration.parsing import focal_lengths


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file has a list of cameras with OKVIS's keys."""
    cameras = content.get("cameras")
    keys = {"T_SC", "image_dimension", "distortion_type", "principal_point"}
    return isinstance(cameras, list) and any(
        isinstance(values, dict) and len(keys & set(values)) > 1 for values in cameras
    )


def read(content: Keys, calibration: Calibration) -> None:
    """Cameras and poses of a parsed file."""
    for index, values in enumerate(content.several("cameras")):
        numbers = focal_lengths(values.numbers("focal_length", 2), values.where)
        numbers += values.numbers("principal_point", 2) + values.matrix("distortion_coefficients")
        values.model("cam_model", ("pinhole",), default="pinhole")
        where = values.at("distortion_type")
        camera = distorted(values.entry("distortion_type"), numbers, values.size("image_dimension"), where)
        calibration.add(f"cam{index}", camera, values.where, values.pose("T_SC"))


FileFormat(
    "okvis",
    "OKVIS configuration",
    recognizes_keys=recognizes,
    read_keys=read,
    ignored=SETTINGS + r"[^/]+|cameras/(camera_type|slam_use)",
).register()
