# SPDX-License-Identifier: Apache-2.0
"""MultiCol-SLAM's YAML, in which the Lafida data set is calibrated: OCam cameras, poses as Cayley parameters.

Convention:
    ``Camera.a0``, ``a1``, ... is the direct polynomial and ``Camera.pol0``, ``pol1``, ... the inverse one, both in
    ascending order; MATLAB's ``ocam_model.pol`` is descending, so its last number is ``pol0``. ``u0`` is the column and
    ``v0`` the row of the centre. The affine part acts on (x, y), not on (row, column):

        u = c x' + d y' + u0,    v = e x' + y' + v0

    ``CameraSystem.cam1_1`` to ``cam1_6`` are Cayley parameters and translation in metres,
    camera to rig.

References:
    S. Urban, S. Hinz, "MultiCol-SLAM", arXiv 1610.07336; S. Urban, B. Jutzi, "LaFiDa", J. Imaging 3 (2017).
"""

from __future__ import annotations

import re
from typing import Any

import torch

from sphericalvision.cameras.calibration.contents import Calibration
from sphericalvision.cameras.calibration.formats import FileFormat
from sphericalvision.cameras.calibration.keys import SETTINGS, Keys, check_understood
from sphericalvision.cameras.calibration.ocam_text import make_ocam
from sphericalvision.cameras.calibration.text_files import load_keys
from sphericalvision.cameras.models.ocam import OCamCamera
from sphericalvision.core import FileFormatError, check_file
from sphericalvision.geometry import transform_from_quaternion

MULTICOL_POSES = "MultiCamSys_Calibration.yaml"
_IGNORED = SETTINGS + r"(?!Camera).*|Camera\.(fps|RGB|mirrorMask)"
_CAMERA_FILE = "InteriorOrientationFisheye{index}.yaml"


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file has keys like ``Camera.a0`` or ``CameraSystem.nrCams``."""
    return any(re.match(r"(Camera\.(a|pol|I[wh]|nr(inv)?pol)|CameraSystem\.)", str(key)) for key in content)


def read(content: Keys, calibration: Calibration) -> None:
    """The camera of a parsed file, or the rig of one with poses, whose cameras are in files beside it."""
    if not any(str(key).startswith("CameraSystem.") for key in content):
        calibration.add(calibration.path.stem, _camera(content), content.where)
        return
    for index in range(content.count("CameraSystem.nrCams", 100)):
        name = f"cam{index + 1}"
        keys = [f"CameraSystem.{name}_{place}" for place in range(1, 7)]
        row = torch.tensor([content.number(key) for key in keys], dtype=torch.float64)
        file = check_file(
            calibration.path.with_name(_CAMERA_FILE.format(index=index)), f"the camera of {keys[0][:-2]}"
        )
        values = load_keys(file, "keys like Camera.a0")
        camera = _camera(values)
        check_understood(values, str(file), _IGNORED)
        quaternion = torch.cat((row.new_ones(1), row[:3]))  # (1, c) up to its length
        calibration.add(name, camera, str(file), transform_from_quaternion(quaternion, row[3:]))


def _polynomial(content: Keys, name: str, count_key: str) -> list[float]:
    """Coefficients ``Camera.<name>0``, ... as many as are announced."""
    count = content.count(count_key, 100)
    if f"Camera.{name}{count}" in content:
        raise FileFormatError(
            f"{content.at(count_key)}: announces {count} coefficients, but Camera.{name}{count} is there"
        )
    return [content.number(f"Camera.{name}{power}") for power in range(count)]


def _camera(content: Keys) -> OCamCamera:
    direct = _polynomial(content, "a", "Camera.nrpol")
    inverse = _polynomial(content, "pol", "Camera.nrinvpol")
    c, d, e, u0, v0 = (content.number(f"Camera.{key}") for key in ("c", "d", "e", "u0", "v0"))
    size = content.size("Camera.Iw", "Camera.Ih")
    return make_ocam(direct, inverse, [u0, v0], [c, d, e], size, content.at("Camera.c"), of_columns=True)


FileFormat(
    "multicol",
    "Lafida/MultiCol yaml",
    recognizes_keys=recognizes,
    read_keys=read,
    ignored=_IGNORED,
    usual_names=(MULTICOL_POSES,),
).register()
