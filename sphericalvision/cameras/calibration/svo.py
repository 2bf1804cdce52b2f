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

from typing import Any

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Calibration
from sphericalvision.cameras.calibration.formats import FileFormat
from sphericalvision.cameras.calibration.keys import SETTINGS, Keys
from sphericalvision.cameras.calibration.lenses import distorted
from sphericalvision.core import FileFormatError

_DISTORTIONS = ("none", "equidistant", "radial-tangential")


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file has a list of mappings ``camera``, or ``cam_model``."""
    cameras = content.get("cameras")
    return "cam_model" in content or (
        isinstance(cameras, list)
        and any(isinstance(v, dict) and isinstance(v.get("camera"), dict) for v in cameras)
    )


def read(content: Keys, calibration: Calibration) -> None:
    """Cameras, called by their labels, and poses of a parsed file."""
    if content.number("scale", 1) != 1:
        raise FileFormatError(
            f"{content.at('scale')}: expected 1, got {content['scale']}; the numbers are those of images before the "
            "program makes them smaller: leave it out to read these"
        )
    if "cam_model" in content:
        calibration.add(calibration.path.stem, _first_age(content), content.where)
        return
    cameras = content.several("cameras")
    lenses = [values.inner("camera") for values in cameras]
    names = [str(lens.get("label") or f"cam{index}") for index, lens in enumerate(lenses)]
    if len(set(names)) < len(names):
        names = [f"cam{index}" for index in range(len(names))]
    for name, lens, values in zip(names, lenses, cameras, strict=True):
        calibration.add(name, _camera(lens), values.where, values.pose("T_B_C"))


def _camera(values: Keys) -> Camera:
    values.chosen("type", ("pinhole",))
    size, plane = values.size("image_width", "image_height"), values.matrix("intrinsics", 4)
    distortion = values.inner("distortion")
    kind = distortion.chosen("type", _DISTORTIONS)
    more = distortion.matrix("parameters") if "parameters" in distortion else []
    return distorted(kind, plane + more, size, distortion.at("parameters"))


def _first_age(content: Keys) -> Camera:
    kind = content.chosen("cam_model", ("ATAN", "Pinhole"))
    height, width = size = content.size("cam_width", "cam_height")
    fx, fy, cx, cy = (content.number(f"cam_{key}") for key in ("fx", "fy", "cx", "cy"))
    if kind == "ATAN":
        plane = [fx * width, fy * height, cx * width - 0.5, cy * height - 0.5]
        return distorted("fov", [*plane, content.number("cam_d0")], size, content.where)
    keys = [f"cam_d{index}" for index in range(4)]
    if not any(key in content for key in keys):
        return distorted("none", [fx, fy, cx, cy], size, content.where)
    more = [content.number(key) for key in keys]
    return distorted("radtan", [fx, fy, cx, cy, *more], size, content.where)


FileFormat(
    "svo",
    "SVO and SVO Pro cameras",
    recognizes_keys=recognizes,
    read_keys=read,
    ignored=SETTINGS + r"(?!cam)[^/]+|cameras/camera/line-delay-nanoseconds",
).register()
