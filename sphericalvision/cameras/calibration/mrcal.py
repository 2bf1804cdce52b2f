# SPDX-License-Identifier: Apache-2.0
"""mrcal's ``.cameramodel``: one camera of OpenCV with its pose, as a Python literal.

Convention:
    ``extrinsics`` (``rt_cam_ref`` since version 2.5) is a rotation vector and a translation in metres, from the
    reference to the camera; the reference is the rig's world. ``imagersize`` is width, height.

References:
    https://mrcal.secretsauce.net/cameramodels.html
"""

from __future__ import annotations

import ast
from pathlib import Path

from sphericalvision.cameras.calibration.contents import Calibration
from sphericalvision.cameras.calibration.formats import FileFormat
from sphericalvision.cameras.calibration.keys import as_keys, check_understood, with_keys
from sphericalvision.cameras.calibration.lenses import distorted
from sphericalvision.cameras.calibration.poses import transform_from_rotation_vector
from sphericalvision.core import FileFormatError
from sphericalvision.geometry import invert_transform
from sphericalvision.io.files import by_numbers, read_text

_MODELS = {
    "LENSMODEL_PINHOLE": ("none", 4),
    "LENSMODEL_OPENCV4": ("radtan", 8),
    "LENSMODEL_OPENCV5": ("radtan", 9),
    "LENSMODEL_OPENCV8": ("rational_polynomial", 12),
    "LENSMODEL_OPENCV12": ("thin_prism", 16),
}


def recognizes(path: Path) -> bool:
    """Whether a file is called ``*.cameramodel``."""
    return path.suffix.lower() == ".cameramodel"


def files_of_rig(folder: Path) -> list[Path]:
    """The camera models of the folder."""
    return sorted(folder.glob("*.cameramodel"), key=by_numbers)


def read(path: Path, calibration: Calibration) -> None:
    """The camera of a file, called like it, and its pose."""
    where = str(path)
    try:
        values = as_keys(with_keys(ast.literal_eval(read_text(path).strip()), where), where)
    except (ValueError, SyntaxError, TypeError, RecursionError, MemoryError) as error:
        raise FileFormatError(f"{path}: not a literal of Python ({error!s:.200}); is it truncated?") from None
    kind, count = _MODELS[values.chosen("lensmodel", _MODELS)]
    camera = distorted(kind, values.numbers("intrinsics", count), values.size("imagersize"), where)
    key = "rt_cam_ref" if "rt_cam_ref" in values else "extrinsics"
    motion = values.numbers(key, 6)
    check_understood(values, where, "valid_intrinsics_region|icam_intrinsics|optimization_inputs")
    pose = invert_transform(transform_from_rotation_vector(motion[:3], motion[3:], values.at(key)))
    calibration.add(path.stem, camera, where, pose)


FileFormat(
    "mrcal",
    "mrcal cameramodel",
    recognizes_file=recognizes,
    read_file=read,
    files_of_rig=files_of_rig,
).register()
