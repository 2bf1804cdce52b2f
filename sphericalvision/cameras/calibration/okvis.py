# SPDX-License-Identifier: Apache-2.0
"""OKVIS's and OKVIS2's configuration: a list of cameras with poses, among settings of the program.

Convention:
    ``T_SC`` takes coordinates of the camera to the sensor's, which is the IMU and the rig's world; metres. Cameras are
    ``cam0``, ``cam1``, ... in the order of the list.

References:
    S. Leutenegger et al., "Keyframe-based visual-inertial odometry using nonlinear optimization", IJRR 34 (2015).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Contents, Options
from sphericalvision.cameras.calibration.formats import FileFormat, register_format
from sphericalvision.cameras.calibration.keys import SETTINGS
from sphericalvision.cameras.calibration.lenses import distorted
from sphericalvision.cameras.calibration.opencv_keys import matrix
from sphericalvision.cameras.calibration.parsing import (
    chosen_model,
    entry,
    focal_lengths,
    numbers,
    size_from_width_height,
)
from sphericalvision.cameras.calibration.poses import transform_from_rows
from sphericalvision.cameras.calibration.visible_part import bounded

__all__ = ["contents", "recognizes"]


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file has a list of cameras with OKVIS's keys."""
    cameras = content.get("cameras")
    keys = {"T_SC", "image_dimension", "distortion_type", "principal_point"}
    return isinstance(cameras, list) and any(
        isinstance(values, dict) and len(keys & set(values)) > 1 for values in cameras
    )


def contents(content: dict[str, Any], path: Path, options: Options) -> Contents:
    """Cameras and poses of a parsed file."""
    cameras: dict[str, Camera] = {}
    poses = []
    for index, values in enumerate(content["cameras"]):
        where = f"{path}, cameras[{index}]"
        plane = [
            *focal_lengths(numbers(entry(values, "focal_length", where), f"{where}, focal_length", 2), where),
            *numbers(entry(values, "principal_point", where), f"{where}, principal_point", 2),
        ]
        kind = entry(values, "distortion_type", where)
        more = matrix(entry(values, "distortion_coefficients", where), f"{where}, distortion_coefficients")
        size = size_from_width_height(entry(values, "image_dimension", where), f"{where}, image_dimension")
        if "cam_model" in values:
            chosen_model(values["cam_model"], ("pinhole",), f"{where}, cam_model")
        camera = distorted(kind, plane + more, size, f"{where}, distortion_type")
        cameras[f"cam{index}"] = bounded(camera, options.max_angle, where)
        pose = entry(values, "T_SC", where)
        poses.append(transform_from_rows(pose, f"{where}, T_SC"))
    return Contents(cameras, torch.stack(poses))


register_format(
    FileFormat(
        "okvis",
        "OKVIS configuration",
        recognizes_keys=recognizes,
        contents_of_keys=contents,
        ignored=SETTINGS + r"[^/]+|cameras/(camera_type|slam_use)",
    )
)
