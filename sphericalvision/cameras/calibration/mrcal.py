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

import torch

from sphericalvision.cameras.calibration.contents import Contents, Options
from sphericalvision.cameras.calibration.files import read_text
from sphericalvision.cameras.calibration.formats import FileFormat, register_format
from sphericalvision.cameras.calibration.keys import Keys, check_understood, noted
from sphericalvision.cameras.calibration.lenses import distorted
from sphericalvision.cameras.calibration.parsing import chosen, entry, numbers, size_from_width_height
from sphericalvision.cameras.calibration.visible_part import bounded
from sphericalvision.core import FileFormatError
from sphericalvision.geometry import invert_transform, transform_from_axis_angle

__all__ = ["contents", "files_of_rig", "recognizes"]

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
    return sorted(folder.glob("*.cameramodel"))


def contents(path: Path, options: Options) -> Contents:
    """The camera of a file, called like it, and its pose."""
    where = str(path)
    try:
        values = noted(ast.literal_eval(read_text(path).strip()))
    except (ValueError, SyntaxError, TypeError, RecursionError, MemoryError) as error:
        raise FileFormatError(f"{path}: not a literal of Python ({error!s:.200}); is it truncated?") from None
    if not isinstance(values, Keys):
        raise FileFormatError(f"{path}: expected keys with values")
    model = chosen(entry(values, "lensmodel", where), _MODELS, f"{where}, lensmodel")
    kind, count = _MODELS[model]
    found = numbers(entry(values, "intrinsics", where), f"{where}, intrinsics", count)
    size = size_from_width_height(entry(values, "imagersize", where), f"{where}, imagersize")
    camera = bounded(distorted(kind, found, size, where), options.max_angle, where)
    key = "rt_cam_ref" if "rt_cam_ref" in values else "extrinsics"
    turn = torch.tensor(numbers(entry(values, key, where), f"{where}, {key}", 6), dtype=torch.float64)
    check_understood(values, where, "valid_intrinsics_region|icam_intrinsics|optimization_inputs")
    return Contents(
        {path.stem: camera}, invert_transform(transform_from_axis_angle(turn[:3], turn[3:]))[None]
    )


register_format(
    FileFormat(
        "mrcal",
        "mrcal cameramodel",
        recognizes_file=recognizes,
        contents_of_file=contents,
        files_of_rig=files_of_rig,
    )
)
