# SPDX-License-Identifier: Apache-2.0
"""MC-Calib's ``calibrated_cameras_data.yml``: pinhole and fisheye cameras of OpenCV with poses.

Convention:
    ``distortion_type`` is 0 for ``cv2.projectPoints`` and 1 for ``cv2.fisheye``. ``camera_pose_matrix`` takes
    coordinates of the camera to those of the reference camera, in the unit of the board, which the file does not tell.

References:
    F. Rameau, J. Park, O. Bailo, I. S. Kweon, "MC-Calib: a generic and robust calibration toolbox for multi-camera
    systems", CVIU 217 (2022).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Contents, Options
from sphericalvision.cameras.calibration.formats import FileFormat, register_format
from sphericalvision.cameras.calibration.lenses import distorted
from sphericalvision.cameras.calibration.opencv_keys import matrix
from sphericalvision.cameras.calibration.parsing import (
    entry,
    mapping,
    metres_per,
    number,
    size_from_width_height,
)
from sphericalvision.cameras.calibration.poses import transform_from_rows
from sphericalvision.cameras.calibration.visible_part import bounded
from sphericalvision.core import ArgumentError, FileFormatError

__all__ = ["contents", "recognizes"]


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file has ``nb_camera``, or cameras with a ``camera_pose_matrix``."""
    cameras = (value for key, value in content.items() if str(key).startswith("camera_"))
    return "nb_camera" in content or any(isinstance(c, dict) and "camera_pose_matrix" in c for c in cameras)


def contents(content: dict[str, Any], path: Path, options: Options) -> Contents:
    """Cameras and poses of a parsed file.

    Raises:
        ArgumentError: poses are wanted and the unit of the translations is not given.
    """
    count = number(content, "nb_camera", str(path))
    if count != int(count) or not 1 <= count <= 1000:
        raise FileFormatError(f"{path}, nb_camera: expected a count from 1 to 1000, got {count:g}")
    names = [f"camera_{index}" for index in range(int(count))]
    several = [mapping(entry(content, name, str(path)), f"{path}, {name}") for name in names]
    if len({str(values.get("camera_group")) for values in several}) > 1:
        raise FileFormatError(f"{path}, camera_group: the groups have no common frame; keep one of them")
    if options.translation_unit is None:
        raise ArgumentError(
            f"translation_unit: {path} does not tell the unit of camera_pose_matrix, which is that of the board; pass "
            "'m', 'cm' or 'mm'"
        )
    cameras: dict[str, Camera] = {}
    poses = []
    for name, values in zip(names, several, strict=True):
        where = f"{path}, {name}"
        (fx, skew, cx), (zero, fy, cy), last = _rows(
            entry(values, "camera_matrix", where), f"{where}, camera_matrix"
        )
        if skew or zero or last != [0.0, 0.0, 1.0]:
            raise FileFormatError(f"{where}, camera_matrix: expected fx 0 cx 0 fy cy 0 0 1")
        more = matrix(entry(values, "distortion_vector", where), f"{where}, distortion_vector")
        kind = number(values, "distortion_type", where)
        if kind not in (0, 1):
            raise FileFormatError(f"{where}, distortion_type: expected 0 or 1, got {kind:g}")
        size = size_from_width_height(
            [entry(values, f"img_{side}", where) for side in ("width", "height")], where
        )
        lens = distorted("equidistant" if kind else "radtan", [fx, fy, cx, cy, *more], size, where)
        cameras[name] = bounded(lens, options.max_angle, where)
        where = f"{where}, camera_pose_matrix"
        pose = transform_from_rows(matrix(entry(values, "camera_pose_matrix", where), where, 16), where)
        pose[:3, 3] *= metres_per(options.translation_unit)
        poses.append(pose)
    return Contents(cameras, torch.stack(poses))


def _rows(value: Any, where: str) -> list[list[float]]:
    found = matrix(value, where, 9)
    return [found[:3], found[3:6], found[6:]]


register_format(
    FileFormat(
        "mc_calib",
        "MC-Calib calibrated_cameras_data",
        recognizes_keys=recognizes,
        contents_of_keys=contents,
        tells_unit=False,
        ignored="",
    )
)
