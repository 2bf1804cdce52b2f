# SPDX-License-Identifier: Apache-2.0
"""OpenCV's FileStorage (YAML, XML or JSON): one camera, or two with the transform between them.

Convention:
    Names of keys are those of OpenCV's samples, in any spelling: ``camera_matrix``, ``cameraMatrix``, ``K`` or ``M``,
    and ``distortion_coefficients``, ``dist_coeffs`` or ``D``; with 1 and 2, or left and right, for two cameras. ``R``
    and ``T`` take coordinates of the first camera to the second's; the world is the first camera's frame.

    Which model it is: ``xi`` makes it ``cv2.omnidir``, ``fisheye_model: 1`` (or the distortion model equidistant)
    ``cv2.fisheye``. Without either, four coefficients called ``D`` are ``cv2.fisheye``'s, as its documentation calls
    them; any other number or name are those of the pinhole with distortion.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Contents, Options
from sphericalvision.cameras.calibration.files import load
from sphericalvision.cameras.calibration.formats import FileFormat, register_format
from sphericalvision.cameras.calibration.opencv_keys import (
    DISTORTION,
    MATRIX,
    ROTATION,
    SIZE,
    TRANSLATION,
    find,
    matrix,
    rotation,
)
from sphericalvision.cameras.calibration.opencv_writer import write_opencv
from sphericalvision.cameras.calibration.parsing import (
    errors_of_file,
    focal_lengths,
    metres_per,
    size_from_width_height,
)
from sphericalvision.cameras.calibration.poses import checked_rigid
from sphericalvision.cameras.calibration.visible_part import bounded
from sphericalvision.cameras.models.brown_conrady import BrownConradyCamera
from sphericalvision.cameras.models.kannala_brandt import KannalaBrandtCamera
from sphericalvision.cameras.models.pinhole import PinholeCamera
from sphericalvision.cameras.models.unified import UnifiedCamera
from sphericalvision.core import ArgumentError, FileFormatError
from sphericalvision.geometry import invert_transform

__all__ = ["contents", "recognizes"]

_PAIRS = {"intrinsics": "extrinsics", "extrinsics": "intrinsics"}
"""File names of OpenCV's stereo sample, each with that of the other half."""


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file has a camera matrix, or the rotation and translation between two cameras."""
    keys = [key for index in ("", "1") if (key := find(content, MATRIX, index))]
    if any(len(key) > 2 or isinstance(content[key], Mapping | list) for key in keys):
        return True
    return bool(find(content, ROTATION) and find(content, TRANSLATION))


def contents(content: dict[str, Any], path: Path, options: Options) -> Contents:
    """The camera or the two cameras of a parsed file.

    Raises:
        ArgumentError: the unit of the translation, or the size of the images, is neither in the file nor given.
    """
    content = _with_other_half(content, path)
    if find(content, MATRIX):
        where = str(path)
        camera = bounded(_camera(content, "", where, options), options.max_angle, where)
        return Contents({str(content.get("camera_name") or "cam1"): camera})
    cameras = {}
    for index in ("1", "2"):
        where = f"{path}, camera {index}"
        cameras[f"cam{index}"] = bounded(_camera(content, index, where, options), options.max_angle, where)
    rotation_key, translation_key = find(content, ROTATION), find(content, TRANSLATION)
    if rotation_key is None or translation_key is None:
        return Contents(cameras)
    unit = content.get("translation_unit") or options.translation_unit
    if unit is None:
        raise ArgumentError(
            f"translation_unit: {path} does not tell the unit of {translation_key}, which is that of the calibration "
            "board's squares; pass 'm', 'cm' or 'mm'"
        )
    second_from_first = torch.eye(4, dtype=torch.float64)
    second_from_first[:3, :3] = rotation(content[rotation_key], f"{path}, {rotation_key}")
    with errors_of_file(str(path)):
        metres = metres_per(str(unit))
    found = matrix(content[translation_key], f"{path}, {translation_key}", 3)
    second_from_first[:3, 3] = torch.tensor(found, dtype=torch.float64) * metres
    checked_rigid(second_from_first, f"{path}, {rotation_key}")
    first = torch.eye(4, dtype=torch.float64)
    return Contents(cameras, torch.stack((first, invert_transform(second_from_first))))


def _with_other_half(content: dict[str, Any], path: Path) -> dict[str, Any]:
    """OpenCV's stereo sample writes intrinsics and extrinsics into two files side by side."""
    other = path.with_name(f"{_PAIRS.get(path.stem, '')}{path.suffix}")
    if path.stem in _PAIRS and other.is_file():
        more = load(other)
        if isinstance(more, dict):
            return {**more, **content}
    return content


def _image_size(content: Mapping[str, Any], index: str, where: str, options: Options) -> tuple[int, int]:
    for suffix in dict.fromkeys((index, "")):
        width = find(content, ("imagewidth", "width"), suffix)
        height = find(content, ("imageheight", "height"), suffix)
        if width and height:
            return size_from_width_height([content[width], content[height]], f"{where}, {width} and {height}")
        both = find(content, SIZE, suffix)
        if both:
            return size_from_width_height(matrix(content[both], f"{where}, {both}", 2), f"{where}, {both}")
    return options.given_size(where, "image_width and image_height")


def _is_fisheye(content: Mapping[str, Any], index: str, distortion_key: str, count: int) -> bool:
    flags, names = ("fisheyemodel", "fisheye"), ("distortionmodel", "cameramodel", "model")
    if flag := find(content, flags, index) or find(content, flags):
        return str(content[flag]).lower() in ("1", "1.0", "true")
    if name := find(content, names, index) or find(content, names):
        return any(word in str(content[name]).lower() for word in ("fisheye", "equidistant", "kannala"))
    return count == 4 and distortion_key.lower().startswith("d") and len(distortion_key) <= 2


def _camera(content: Mapping[str, Any], index: str, where: str, options: Options) -> Camera:
    key = find(content, MATRIX, index)
    if key is None:
        raise FileFormatError(
            f"{where}: the camera matrix is missing (camera_matrix{index}, K{index} or M{index}); found "
            f"{', '.join(map(str, content))}"
        )
    skew: float | None
    fx, skew, cx, _, fy, cy, *last = matrix(content[key], f"{where}, {key}", 9)
    if last != [0.0, 0.0, 1.0]:
        raise FileFormatError(f"{where}, {key}: expected 0 0 1 in the last row, got {last}")
    focal_length = torch.tensor(focal_lengths([fx, fy], f"{where}, {key}"), dtype=torch.float64)
    size = _image_size(content, index, where, options)
    distortion_key = find(content, DISTORTION, index)
    coefficients: list[float] = []
    if distortion_key is not None:
        coefficients = matrix(content[distortion_key], f"{where}, {distortion_key}")
    xi = find(content, ("xi",), index)
    fisheye = distortion_key is not None and _is_fisheye(content, index, distortion_key, len(coefficients))
    if abs(skew) <= 1e-9 * abs(fx):
        skew = None
    elif xi is None and not fisheye:
        raise FileFormatError(
            f"{where}, {key}: a skew of {skew:g} is for fisheye and omnidirectional cameras; OpenCV's others have none"
        )
    with errors_of_file(where if distortion_key is None else f"{where}, {distortion_key}"):
        if xi is not None:
            distortion = _with_k3(coefficients, f"{where}, {distortion_key}")
            value = matrix(content[xi], f"{where}, {xi}", 1)[0]
            return UnifiedCamera(focal_length, [cx, cy], value, distortion, size, skew=skew)
        if fisheye:
            return KannalaBrandtCamera(focal_length, [cx, cy], coefficients, size, math.pi, skew)
        if not coefficients:
            return PinholeCamera(focal_length, [cx, cy], size)
        return BrownConradyCamera(focal_length, [cx, cy], coefficients, size)


def _with_k3(coefficients: list[float], where: str) -> list[float] | None:
    """Mei's k1 k2 p1 p2 with a k3 of 0 behind, or ``None`` without any."""
    if not coefficients:
        return None
    if len(coefficients) not in (4, 5):
        raise FileFormatError(
            f"{where}: expected k1 k2 p1 p2, and k3 at most, got {len(coefficients)} numbers"
        )
    return [*coefficients, 0.0][:5]


register_format(
    FileFormat(
        "opencv",
        "OpenCV FileStorage",
        recognizes_keys=recognizes,
        contents_of_keys=contents,
        usual_names=("extrinsics.yml",),
        tells_unit=False,
        models=("pinhole", "brown_conrady", "kannala_brandt", "unified"),
        write_camera=write_opencv,
        write_rig=write_opencv,
    )
)
