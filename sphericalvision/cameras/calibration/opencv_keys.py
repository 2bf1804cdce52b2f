# SPDX-License-Identifier: Apache-2.0
"""How OpenCV's files spell their keys, and how they hold matrices."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.calibration.parsing import matrix
from sphericalvision.cameras.calibration.poses import checked_radians
from sphericalvision.core import FileFormatError

MATRIX = ("cameramatrix", "k", "m", "mtx")
_COEFFICIENTS = ("", "coefficient", "coeff", "coef", "vector", "vec", "parameter", "param")
_DISTORTION = [f"{start}{end}" for start in ("dist", "distortion") for end in _COEFFICIENTS]
DISTORTION = ("d", "kc", *_DISTORTION, *(f"{name}s" for name in _DISTORTION))
MODEL = ("distortionmodel", "distortiontype", "cameramodel", "cameratype", "model", "lensmodel", "lenstype")
SIZE = ("cameraresolution", "imagesize", "imgsize", "resolution", "dim")
ROTATION = ("r", "rotation", "rotationmatrix", "rvec", "om")
TRANSLATION = ("t", "translation", "tvec")
_INDICES = {"1": ("1", "left", "l"), "2": ("2", "right", "r")}


def find(content: Mapping[Any, Any], names: tuple[str, ...], index: str = "", where: str = "") -> str | None:
    """The key that spells one of ``names``, with the index of a camera if there are two."""
    spellings = set(names)
    if index:
        ends = _INDICES[index]
        spellings = {f"{name}{end}" for name in names for end in ends} | {
            f"{end}{name}" for name in names for end in ends[1:2]
        }
    keys = [str(key) for key in content if re.sub(r"[^a-z0-9]", "", str(key).lower()) in spellings]
    if where and len(keys) > 1:
        read = rotation if names is ROTATION else _plain
        values = [read(content[key], f"{where}, {key}") for key in keys]
        if not all(np.array_equal(values[0], value) or np.allclose(values[0], value) for value in values[1:]):
            raise FileFormatError(
                f"{where}: {' and '.join(keys)} stand for the same thing and differ; keep one"
            )
    return keys[0] if keys else None


def _plain(value: Any, where: str) -> Any:
    return matrix(value, where) if isinstance(value, Mapping | list) else str(value)


def rotation(value: Any, where: str) -> Float[Tensor, "3 3"]:
    """A rotation (3, 3) from a matrix or a rotation vector."""
    elements = matrix(value, where)
    if len(elements) == 3:
        return torch.from_numpy(cv2.Rodrigues(np.array(checked_radians(elements, where)))[0])
    if len(elements) != 9:
        raise FileFormatError(
            f"{where}: expected a 3 x 3 rotation or a rotation vector, got {len(elements)} numbers"
        )
    return torch.tensor(elements, dtype=torch.float64).reshape(3, 3)
