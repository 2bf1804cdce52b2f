# SPDX-License-Identifier: Apache-2.0
"""Project Aria's device calibration (json): fisheye cameras of a pair of glasses, with poses.

Convention:
    A camera of ``CameraCalibrations`` is called by its ``Label``. ``Params`` of ``FisheyeRadTanThinPrism`` are f cx cy,
    k0 to k5, p0 p1, s0 to s3, where p0 and p1 are OpenCV's p2 and p1; of ``KannalaBrandtK3`` fx fy cx cy, k0 to k3.
    ``T_Device_Camera`` takes coordinates of the camera to the device's, in metres; the device is the rig's world. Its
    quaternion is [w, [x, y, z]]. Centres of pixels have whole coordinates.

    The file does not tell sizes. They are those of the sensors in full, by label, unless ``image_size`` is given.

References:
    J. Engel et al., "Project Aria: a new tool for egocentric multi-modal AI research", arXiv 2308.13561.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Contents, Options
from sphericalvision.cameras.calibration.formats import FileFormat, register_format
from sphericalvision.cameras.calibration.parsing import entry, errors_of_file, focal_lengths, numbers
from sphericalvision.cameras.calibration.visible_part import bounded
from sphericalvision.cameras.models.kannala_brandt import KannalaBrandtCamera
from sphericalvision.cameras.models.thin_prism_fisheye import ThinPrismFisheyeCamera
from sphericalvision.core import ArgumentError, FileFormatError, short_repr
from sphericalvision.geometry import transform_from_quaternion

__all__ = ["contents", "recognizes"]

_COUNTS = {"FisheyeRadTanThinPrism": 15, "KannalaBrandtK3": 8}
_SIZES = {"camera-slam": (480, 640), "camera-rgb": (2880, 2880), "camera-et": (240, 320)}
"""(height, width) by the beginning of the label."""


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file has ``CameraCalibrations``."""
    return "CameraCalibrations" in content


def contents(content: dict[str, Any], path: Path, options: Options) -> Contents:
    """Cameras and poses of a parsed file.

    Raises:
        FileFormatError: a key is missing, or its value makes no sense; the message names file and key.
        ArgumentError: the size of a camera is not known by its label, and not given.
    """
    entries = content["CameraCalibrations"]
    if not isinstance(entries, list) or not entries:
        raise FileFormatError(f"{path}, CameraCalibrations: expected a list of at least one camera")
    cameras: dict[str, Camera] = {}
    poses = []
    for index, values in enumerate(entries):
        where = f"{path}, CameraCalibrations[{index}]"
        label = entry(values, "Label", where)
        if not isinstance(label, str) or label in cameras:
            raise FileFormatError(f"{where}, Label: expected a name of its own, got {short_repr(label)}")
        camera = _camera(entry(values, "Projection", where), label, f"{where}, Projection", options)
        cameras[label] = bounded(camera, options.max_angle, where)
        poses.append(_pose(entry(values, "T_Device_Camera", where), f"{where}, T_Device_Camera"))
    return Contents(cameras, torch.stack(poses))


def _camera(values: Any, label: str, where: str, options: Options) -> Camera:
    kind = entry(values, "Name", where)
    if not isinstance(kind, str) or kind not in _COUNTS:
        raise FileFormatError(f"{where}, Name: expected {' or '.join(_COUNTS)}, got {short_repr(kind)}")
    found = numbers(entry(values, "Params", where), f"{where}, Params", _COUNTS[kind])
    size = options.image_size or next((s for start, s in _SIZES.items() if label.startswith(start)), None)
    if size is None:
        raise ArgumentError(
            f"image_size: {where} does not tell it for {label!r}; pass image_size=(height, width)"
        )
    with errors_of_file(where):
        if kind == "KannalaBrandtK3":
            focal_length = torch.tensor(focal_lengths(found[:2], where), dtype=torch.float64)
            return KannalaBrandtCamera(focal_length, found[2:4], found[4:], size, math.pi)
        focal_length = torch.tensor(focal_lengths(found[:1] * 2, where), dtype=torch.float64)
        p0, p1 = found[9:11]
        terms = (found[3:9], [p1, p0], found[11:])
        return ThinPrismFisheyeCamera(focal_length, found[1:3], *terms, size, math.pi)


def _pose(values: Any, where: str) -> Tensor:
    translation = numbers(entry(values, "Translation", where), f"{where}, Translation", 3)
    quaternion = entry(values, "UnitQuaternion", where)
    if not isinstance(quaternion, list) or len(quaternion) != 2:
        raise FileFormatError(
            f"{where}, UnitQuaternion: expected [w, [x, y, z]], got {short_repr(quaternion)}"
        )
    w = numbers(quaternion[0], f"{where}, UnitQuaternion", 1)
    found = [*w, *numbers(quaternion[1], f"{where}, UnitQuaternion", 3)]
    if not 0.99 < (length := math.hypot(*found)) < 1.01:
        raise FileFormatError(f"{where}, UnitQuaternion: expected length 1, got {length:.3g}")
    return transform_from_quaternion(
        torch.tensor(found, dtype=torch.float64), torch.tensor(translation, dtype=torch.float64)
    )


register_format(
    FileFormat("aria", "Project Aria json", recognizes_keys=recognizes, contents_of_keys=contents)
)
