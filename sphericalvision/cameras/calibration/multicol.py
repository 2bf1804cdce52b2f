# SPDX-License-Identifier: Apache-2.0
"""MultiCol-SLAM's YAML, in which the Lafida data set is calibrated: OCam cameras, poses as Cayley parameters.

Convention:
    ``Camera.a0``, ``a1``, ... is the direct polynomial and ``Camera.pol0``, ``pol1``, ... the inverse one, both in
    ascending order; MATLAB's ``ocam_model.pol`` is descending, so its last number is ``pol0``. ``u0`` is the column and
    ``v0`` the row of the centre. The affine part acts on (x, y), not on (row, column):

        u = c x' + d y' + u0,    v = e x' + y' + v0

    An ``OCamCamera`` with 1 where this has c is the same camera when radii are counted in units c times smaller, which
    is what the reader does. ``CameraSystem.cam1_1`` to ``cam1_6`` are Cayley parameters and translation in metres,
    camera to rig.

References:
    S. Urban, S. Hinz, "MultiCol-SLAM", arXiv 1610.07336; S. Urban, B. Jutzi, "LaFiDa", J. Imaging 3 (2017).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import torch

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Contents, Options
from sphericalvision.cameras.calibration.files import load_keys
from sphericalvision.cameras.calibration.formats import FileFormat, register_format
from sphericalvision.cameras.calibration.keys import SETTINGS, check_understood
from sphericalvision.cameras.calibration.ocam_text import check_inverse
from sphericalvision.cameras.calibration.parsing import errors_of_file, number, size_from_width_height
from sphericalvision.cameras.calibration.visible_part import bounded
from sphericalvision.cameras.models.ocam import OCamCamera
from sphericalvision.core import FileFormatError, check_file
from sphericalvision.geometry import transform_from_quaternion

__all__ = ["MULTICOL_POSES", "contents", "recognizes"]

MULTICOL_POSES = "MultiCamSys_Calibration.yaml"
_IGNORED = SETTINGS + r"(?!Camera).*|Camera\.(fps|RGB|mirrorMask)"
_CAMERA_FILE = "InteriorOrientationFisheye{index}.yaml"


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file has keys like ``Camera.a0`` or ``CameraSystem.nrCams``."""
    return any(re.match(r"(Camera\.(a|pol|I[wh]|nr(inv)?pol)|CameraSystem\.)", str(key)) for key in content)


def contents(content: dict[str, Any], path: Path, options: Options) -> Contents:
    """The camera of a parsed file, or the rig of one with poses, whose cameras are in files beside it.

    Raises:
        MissingFileError: there are poses, but the file of a camera is not beside them.
    """
    if any(str(key).startswith("CameraSystem.") for key in content):
        return _rig(content, path, options)
    camera = bounded(_camera(content, str(path)), options.max_angle, str(path))
    return Contents({path.stem: camera})


def _rig(content: dict[str, Any], path: Path, options: Options) -> Contents:
    cameras: dict[str, Camera] = {}
    rows = []
    for index in range(_count(content, "CameraSystem.nrCams", str(path))):
        name = f"cam{index + 1}"
        keys = [f"CameraSystem.{name}_{place}" for place in range(1, 7)]
        rows.append([number(content, key, str(path)) for key in keys])
        file = check_file(path.with_name(_CAMERA_FILE.format(index=index)), f"the camera of {keys[0][:-2]}")
        values = load_keys(file, "keys like Camera.a0")
        cameras[name] = bounded(_camera(values, str(file)), options.max_angle, str(file))
        check_understood(values, str(file), _IGNORED)
    table = torch.tensor(rows, dtype=torch.float64)
    quaternion = torch.cat((torch.ones_like(table[:, :1]), table[:, :3]), dim=-1)  # (1, c) up to its length
    return Contents(cameras, transform_from_quaternion(quaternion, table[:, 3:]))


def _count(content: dict[str, Any], key: str, where: str) -> int:
    value = number(content, key, where)
    if value != int(value) or not 1 <= value <= 100:
        raise FileFormatError(f"{where}, {key}: expected a count from 1 to 100, got {value:g}")
    return int(value)


def _polynomial(content: dict[str, Any], name: str, count_key: str, where: str) -> torch.Tensor:
    """Coefficients ``Camera.<name>0``, ... as many as are announced."""
    count = _count(content, count_key, where)
    if f"Camera.{name}{count}" in content:
        raise FileFormatError(
            f"{where}, {count_key}: announces {count} coefficients, but Camera.{name}{count} is there"
        )
    found = [number(content, f"Camera.{name}{power}", where) for power in range(count)]
    return torch.tensor(found, dtype=torch.float64)


def _camera(content: dict[str, Any], where: str) -> OCamCamera:
    direct = _polynomial(content, "a", "Camera.nrpol", where)
    inverse = _polynomial(content, "pol", "Camera.nrinvpol", where)
    c, d, e, u0, v0 = (number(content, f"Camera.{key}", where) for key in ("c", "d", "e", "u0", "v0"))
    if not c > 0:
        raise FileFormatError(f"{where}, Camera.c: expected a number above 0, near 1, got {c:g}")
    size = [content.get(key) for key in ("Camera.Iw", "Camera.Ih")]
    image_size = size_from_width_height(size, f"{where}, Camera.Iw and Camera.Ih")
    powers = torch.arange(len(direct), dtype=torch.float64)
    with errors_of_file(where):
        camera = OCamCamera(
            polynomial=direct * c ** (1 - powers),
            inverse_polynomial=inverse * c,
            principal_point=[u0, v0],
            affine=[1 / c, e / c, d / c],
            image_size=image_size,
            max_angle=torch.pi,
        )
    return check_inverse(camera, where)


register_format(
    FileFormat(
        "multicol",
        "Lafida/MultiCol yaml",
        recognizes_keys=recognizes,
        contents_of_keys=contents,
        ignored=_IGNORED,
        usual_names=(MULTICOL_POSES,),
    )
)
