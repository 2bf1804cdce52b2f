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

from typing import Any

from sphericalvision.cameras.calibration.contents import Calibration
from sphericalvision.cameras.calibration.formats import FileFormat
from sphericalvision.cameras.calibration.keys import Keys
from sphericalvision.cameras.calibration.lenses import distorted
from sphericalvision.cameras.calibration.parsing import camera_matrix
from sphericalvision.core import FileFormatError


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file has ``nb_camera``, or cameras with a ``camera_pose_matrix``."""
    cameras = (value for key, value in content.items() if str(key).startswith("camera_"))
    return "nb_camera" in content or any(isinstance(c, dict) and "camera_pose_matrix" in c for c in cameras)


def read(content: Keys, calibration: Calibration) -> None:
    """Cameras and poses of a parsed file."""
    names = [f"camera_{index}" for index in range(content.count("nb_camera", 1000))]
    several = [content.inner(name) for name in names]
    if len({str(values.get("camera_group")) for values in several}) > 1:
        raise FileFormatError(
            f"{content.where}, camera_group: the groups have no common frame; keep one of them"
        )
    unit = calibration.options.metres(content.where, "camera_pose_matrix, which is that of the board")
    for name, values in zip(names, several, strict=True):
        plane, _ = camera_matrix(values.matrix("camera_matrix", 9), values.at("camera_matrix"))
        numbers = [*plane, *values.matrix("distortion_vector")]
        kind = values.number("distortion_type")
        if kind not in (0, 1):
            raise FileFormatError(f"{values.at('distortion_type')}: expected 0 or 1, got {kind:g}")
        size = values.size("img_width", "img_height")
        camera = distorted("equidistant" if kind else "radtan", numbers, size, values.where)
        pose = values.pose("camera_pose_matrix")
        pose[:3, 3] *= unit
        calibration.add(name, camera, values.where, pose)


FileFormat(
    "mc_calib",
    "MC-Calib calibrated_cameras_data",
    recognizes_keys=recognizes,
    read_keys=read,
    tells_unit=False,
    ignored="",
).register()
