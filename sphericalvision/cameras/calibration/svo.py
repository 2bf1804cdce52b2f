# SPDX-License-Identifier: Apache-2.0
"""SVO's cameras: the rig of SVO Pro, and the one camera of the first SVO.

Convention:
    ``T_B_C`` takes coordinates of the camera to the body's, the rig's world, in metres. SVO calls the arc tangent of
    PTAM ``fisheye``; other programs mean another lens by that word, so it is refused. The numbers of ``ATAN`` in the
    first SVO are shares of the width and the height, and the first pixel's centre is at (0.5, 0.5).

References:
    C. Forster et al., "SVO: semidirect visual odometry for monocular and multicamera systems", T-RO 33 (2017), and the
    files of its repositories.
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
from sphericalvision.cameras.calibration.parsing import chosen, entry, mapping, number, size_from_width_height
from sphericalvision.cameras.calibration.poses import transform_from_rows
from sphericalvision.cameras.calibration.visible_part import bounded
from sphericalvision.core import FileFormatError

__all__ = ["contents", "recognizes"]

_DISTORTIONS = ("none", "equidistant", "radial-tangential")


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file has a list of mappings ``camera``, or ``cam_model``."""
    cameras = content.get("cameras")
    return "cam_model" in content or (
        isinstance(cameras, list)
        and any(isinstance(v, dict) and isinstance(v.get("camera"), dict) for v in cameras)
    )


def contents(content: dict[str, Any], path: Path, options: Options) -> Contents:
    """Cameras, called by their labels, and poses of a parsed file."""
    if "scale" in content and number(content, "scale", str(path)) != 1:
        raise FileFormatError(
            f"{path}, scale: expected 1, got {content['scale']}; the numbers are those of images before the program "
            "makes them smaller: leave it out to read these"
        )
    if "cam_model" in content:
        return Contents({path.stem: bounded(_first_age(content, str(path)), options.max_angle, str(path))})
    cameras: dict[str, Camera] = {}
    poses = []
    wheres = [f"{path}, cameras[{index}]" for index in range(len(content["cameras"]))]
    lenses = [
        mapping(entry(values, "camera", where), f"{where}, camera")
        for values, where in zip(content["cameras"], wheres, strict=True)
    ]
    names = [str(lens.get("label") or f"cam{index}") for index, lens in enumerate(lenses)]
    if len(set(names)) < len(names):
        names = [f"cam{index}" for index in range(len(names))]
    for name, lens, values, where in zip(names, lenses, content["cameras"], wheres, strict=True):
        cameras[name] = bounded(_camera(lens, where), options.max_angle, where)
        pose = matrix(entry(values, "T_B_C", where), f"{where}, T_B_C", 16)
        poses.append(transform_from_rows(pose, f"{where}, T_B_C"))
    return Contents(cameras, torch.stack(poses))


def _camera(values: Any, where: str) -> Camera:
    chosen(entry(values, "type", where), ("pinhole",), f"{where}, type")
    size = size_from_width_height(
        [entry(values, f"image_{side}", where) for side in ("width", "height")], where
    )
    plane = matrix(entry(values, "intrinsics", where), f"{where}, intrinsics", 4)
    distortion = entry(values, "distortion", where)
    kind = chosen(
        entry(distortion, "type", f"{where}, distortion"), _DISTORTIONS, f"{where}, distortion, type"
    )
    more = matrix(distortion.get("parameters", []), f"{where}, distortion, parameters")
    return distorted(kind, plane + more, size, f"{where}, distortion, parameters")


def _first_age(content: Any, where: str) -> Camera:
    kind = chosen(content["cam_model"], ("ATAN", "Pinhole"), f"{where}, cam_model")
    width, height = (number(content, f"cam_{side}", where) for side in ("width", "height"))
    size = size_from_width_height([width, height], f"{where}, cam_width and cam_height")
    fx, fy, cx, cy = (number(content, f"cam_{key}", where) for key in ("fx", "fy", "cx", "cy"))
    if kind == "ATAN":
        plane = [fx * width, fy * height, cx * width - 0.5, cy * height - 0.5]
        return distorted("fov", [*plane, number(content, "cam_d0", where)], size, where)
    keys = [f"cam_d{index}" for index in range(4)]
    if not any(key in content for key in keys):
        return distorted("none", [fx, fy, cx, cy], size, where)
    more = [number(content, key, where) for key in keys]
    return distorted("radtan", [fx, fy, cx, cy, *more], size, where)


register_format(
    FileFormat(
        "svo",
        "SVO and SVO Pro cameras",
        recognizes_keys=recognizes,
        contents_of_keys=contents,
        ignored=SETTINGS + r"(?!cam)[^/]+|cameras/camera/line-delay-nanoseconds",
    )
)
