# SPDX-License-Identifier: Apache-2.0
"""EuRoC's ``sensor.yaml``, one camera with its pose a file, in a folder of the camera's name.

Convention:
    ``T_BS`` takes coordinates of the sensor to the body's, in metres; the body is the rig's world. A folder with
    ``cam0/sensor.yaml``, ``cam1/sensor.yaml``, ... (``mav0``) is a rig.

References:
    M. Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 35 (2016), section 4.
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
from sphericalvision.cameras.calibration.opencv_keys import matrix
from sphericalvision.cameras.calibration.parsing import (
    entry,
    errors_of_file,
    focal_lengths,
    numbers,
    size_from_width_height,
)
from sphericalvision.cameras.calibration.poses import transform_from_rows
from sphericalvision.cameras.calibration.supported_models import (
    check_holds,
    numbers_of,
    without_trailing_zeros,
)
from sphericalvision.cameras.calibration.visible_part import bounded
from sphericalvision.cameras.models.brown_conrady import BrownConradyCamera
from sphericalvision.cameras.models.kannala_brandt import KannalaBrandtCamera
from sphericalvision.cameras.models.pinhole import PinholeCamera
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import FileFormatError, short_repr
from sphericalvision.io.files import write_yaml

__all__ = ["contents", "files_of_rig", "recognizes", "write_asl_camera", "write_asl_rig"]

_NAME = "sensor.yaml"
_DISTORTIONS = ("none", "radial-tangential", "equidistant")


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file has a pose ``T_BS``, or says that it is of a sensor."""
    return "T_BS" in content or "sensor_type" in content


def files_of_rig(folder: Path) -> list[Path]:
    """``cam0/sensor.yaml``, ``cam1/sensor.yaml``, ... of the folder."""
    return sorted(folder.glob(f"cam*/{_NAME}"))


def contents(content: dict[str, Any], path: Path, options: Options) -> Contents:
    """The camera of a parsed file, called like the folder that it is in, and its pose if the file has one.

    Raises:
        FileFormatError: a key is missing, or its value makes no sense; the message names file and key.
    """
    where = str(path)
    kind = content.get("sensor_type", "camera")
    if kind != "camera":
        raise FileFormatError(f"{where}, sensor_type: expected camera, got {short_repr(kind)}")
    camera = bounded(_camera(content, where), options.max_angle, where)
    pose = None
    if "T_BS" in content:
        pose = transform_from_rows(matrix(content["T_BS"], f"{where}, T_BS", 16), f"{where}, T_BS")[None]
    name = path.resolve().parent.name if path.name == _NAME else path.stem
    return Contents({name: camera}, pose)


def _camera(content: dict[str, Any], where: str) -> Camera:
    model = entry(content, "camera_model", where)
    if model != "pinhole":
        raise FileFormatError(f"{where}, camera_model: expected pinhole, got {short_repr(model)}")
    fu, fv, *center = numbers(entry(content, "intrinsics", where), f"{where}, intrinsics (fu fv cu cv)", 4)
    focal_length = torch.tensor(focal_lengths([fu, fv], f"{where}, intrinsics"), dtype=torch.float64)
    size = size_from_width_height(entry(content, "resolution", where), f"{where}, resolution")
    distortion = content.get("distortion_model", "none")
    if distortion not in _DISTORTIONS:
        raise FileFormatError(
            f"{where}, distortion_model: expected {' or '.join(_DISTORTIONS)}, got {short_repr(distortion)}"
        )
    with errors_of_file(where):
        if distortion == "none":
            return PinholeCamera(focal_length, center, size)
        key = "distortion_coefficients"
        coefficients = numbers(entry(content, key, where), f"{where}, {key}", 4)
        if distortion == "equidistant":
            return KannalaBrandtCamera(focal_length, center, coefficients, size, math.pi)
        return BrownConradyCamera(focal_length, center, coefficients, size)


def write_asl_camera(camera: Camera, path: str | Path) -> None:
    """Write one camera as ``sensor.yaml``, in the body's place; fields of view are not part of the format.

    Raises:
        ArgumentError: the format has no such model; the message names formats that have it.
    """
    write_yaml(path, _values(camera, torch.eye(4)))


def write_asl_rig(rig: CameraRig, folder: str | Path) -> None:
    """Write ``cam0/sensor.yaml``, ``cam1/sensor.yaml``, ... in the order of the rig into ``folder``.

    Raises:
        ArgumentError: the format has no such model; the message names formats that have it.
    """
    values = [
        _values(camera, pose)
        for camera, pose in zip(rig.cameras.values(), rig.world_from_camera, strict=True)
    ]
    for index, content in enumerate(values):
        path = Path(folder) / f"cam{index}" / _NAME
        path.parent.mkdir(parents=True, exist_ok=True)
        write_yaml(path, content)


def _values(camera: Camera, body_from_camera: Tensor) -> dict[str, Any]:
    check_holds("asl", camera)
    assert isinstance(camera, PinholeCamera | BrownConradyCamera | KannalaBrandtCamera)
    distortion, coefficients = "none", []
    if isinstance(camera, BrownConradyCamera):
        distortion = "radial-tangential"
        coefficients = without_trailing_zeros(numbers_of(camera.distortion), (4,), "distortion (k1 k2 p1 p2)")
    elif isinstance(camera, KannalaBrandtCamera):
        distortion = "equidistant"
        coefficients = without_trailing_zeros(numbers_of(camera.distortion), (4,), "distortion")
    height, width = camera.image_size
    return {
        "sensor_type": "camera",
        "T_BS": {"rows": 4, "cols": 4, "data": numbers_of(body_from_camera)},
        "resolution": [width, height],
        "camera_model": "pinhole",
        "intrinsics": [*numbers_of(camera.focal_length), *numbers_of(camera.principal_point)],
        "distortion_model": distortion,
        "distortion_coefficients": coefficients,
    }


register_format(
    FileFormat(
        "asl",
        f"EuRoC {_NAME}",
        recognizes_keys=recognizes,
        contents_of_keys=contents,
        files_of_rig=files_of_rig,
        usual_names=(_NAME,),
        models=("pinhole", "brown_conrady", "kannala_brandt"),
        write_camera=write_asl_camera,
        write_rig=write_asl_rig,
    )
)
