# SPDX-License-Identifier: Apache-2.0
"""EuRoC's ``sensor.yaml``, one camera with its pose a file, in a folder of the camera's name.

Convention:
    ``T_BS`` takes coordinates of the sensor to the body's, in metres; the body is the rig's world. A folder with
    ``cam0/sensor.yaml``, ``cam1/sensor.yaml``, ... (``mav0``) is a rig.

References:
    M. Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 35 (2016), section 4.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Calibration
from sphericalvision.cameras.calibration.formats import FileFormat, has_any
from sphericalvision.cameras.calibration.keys import Keys
from sphericalvision.cameras.calibration.lenses import Lens, lens_called, lens_of, models_of, numbers_of
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import ArgumentError
from sphericalvision.io.files import by_numbers
from sphericalvision.io.yaml_files import write_yaml

_NAME = "sensor.yaml"
_LENSES = (
    Lens("none", "pinhole", "fu=fx fv=fy cu=cx cv=cy"),
    Lens("radial-tangential", "brown_conrady", "fu=fx fv=fy cu=cx cv=cy k1 k2 p1 p2"),
    Lens("equidistant", "kannala_brandt", "fu=fx fv=fy cu=cx cv=cy k1 k2 k3 k4"),
)
"""By the model of distortion, whose numbers are a list of their own."""


def files_of_rig(folder: Path) -> list[Path]:
    """``cam0/sensor.yaml``, ``cam1/sensor.yaml``, ... of the folder, next to which there is no copy ``cam1_old``."""
    files = sorted(folder.glob(f"cam*/{_NAME}"), key=by_numbers)
    others = [file.parent.name for file in files if not re.fullmatch(r"cam\d+", file.parent.name)]
    if 0 < len(others) < len(files):
        raise ArgumentError(
            f"path: {folder} holds {', '.join(others)} next to cam0, cam1, ...; move what is a copy"
        )
    return files


def read(content: Keys, calibration: Calibration) -> None:
    """The camera of a parsed file, called like the folder that it is in, and its pose if the file has one."""
    content.chosen("sensor_type", ("camera",), default="camera")
    camera = _camera(content)
    pose = content.pose("T_BS") if "T_BS" in content else None
    name = calibration.path.resolve().parent.name if calibration.path.name == _NAME else calibration.path.stem
    calibration.add(name, camera, content.where, pose)


def _camera(content: Keys) -> Camera:
    content.chosen("camera_model", ("pinhole",))
    kinds = [lens.name for lens in _LENSES]
    lens = lens_called(_LENSES, content.model("distortion_model", kinds, default="none"))
    intrinsics = content.numbers("intrinsics", 4) + content.coefficients(
        "distortion_coefficients", len(lens.keys) - 4
    )
    return lens.camera(intrinsics, content.size("resolution"), content.where)


def write_asl_camera(camera: Camera, path: str | Path) -> None:
    """Write one camera as ``sensor.yaml``, in the body's place; fields of view are not part of the format."""
    write_yaml(path, _values(camera, torch.eye(4)))


def write_asl_rig(rig: CameraRig, folder: str | Path) -> None:
    """Write ``cam0/sensor.yaml``, ``cam1/sensor.yaml``, ... in the order of the rig into ``folder``."""
    folder = Path(folder)
    own = {f"cam{index}" for index in range(len(rig))}
    if others := [file for file in files_of_rig(folder) if file.parent.name not in own]:
        raise ArgumentError(
            f"path: {others[0]} would be one more camera of this rig of {len(rig)}; remove it, or write elsewhere"
        )
    values = [
        _values(camera, pose)
        for camera, pose in zip(rig.cameras.values(), rig.world_from_camera, strict=True)
    ]
    for index, content in enumerate(values):
        path = folder / f"cam{index}" / _NAME
        path.parent.mkdir(parents=True, exist_ok=True)
        write_yaml(path, content)


def _values(camera: Camera, body_from_camera: Tensor) -> dict[str, Any]:
    lens, intrinsics = lens_of(camera, _LENSES, "asl")
    return {
        "sensor_type": "camera",
        "T_BS": {"rows": 4, "cols": 4, "data": numbers_of(body_from_camera)},
        "resolution": list(camera.image_size[::-1]),
        "camera_model": "pinhole",
        "intrinsics": intrinsics[:4],
        "distortion_model": lens.name,
        "distortion_coefficients": intrinsics[4:],
    }


FileFormat(
    "asl",
    f"EuRoC {_NAME}",
    recognizes_keys=has_any("T_BS", "sensor_type"),
    read_keys=read,
    ignored="",
    files_of_rig=files_of_rig,
    usual_names=(_NAME,),
    models=models_of(_LENSES),
    write_camera=write_asl_camera,
    write_rig=write_asl_rig,
).register()
