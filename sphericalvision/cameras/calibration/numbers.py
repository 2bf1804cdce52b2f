# SPDX-License-Identifier: Apache-2.0
"""What every calibration reader needs: checked numbers, units, fields of view, masks and a plausible rig."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import torch
from torch import Tensor

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import FileFormatError, check_choice, check_file

__all__ = [
    "METRES_PER_UNIT",
    "check_radius",
    "entry",
    "mapping",
    "metres_per",
    "numbers",
    "read_mask",
    "widest_angle",
]

METRES_PER_UNIT = {"m": 1.0, "cm": 0.01, "mm": 0.001}


def metres_per(unit: str) -> float:
    """Metres in one ``"m"``, ``"cm"`` or ``"mm"``."""
    check_choice("translation_unit", unit, tuple(METRES_PER_UNIT))
    return METRES_PER_UNIT[unit]


def numbers(values: Any, where: str, count: int | None = None) -> list[float]:
    """``values`` as finite floats, ``count`` of them if given; ``where`` names file and line or key in errors.

    Raises:
        FileFormatError: something is no number, not finite, or the count differs.

    Examples:
        >>> numbers(["1", 2], "poses.txt, line 1", count=2)
        [1.0, 2.0]
    """
    values = list(values) if isinstance(values, list | tuple) else [values]
    if count is not None and len(values) != count:
        raise FileFormatError(f"{where}: expected {count} numbers, got {len(values)}; is the file truncated?")
    if not values:
        raise FileFormatError(f"{where}: expected numbers, got an empty list")
    try:
        result = [float(value) for value in values]
    except (TypeError, ValueError):
        raise FileFormatError(f"{where}: expected numbers, got {values}") from None
    if not all(math.isfinite(value) for value in result):
        raise FileFormatError(f"{where}: expected finite numbers, got {values}; correct the file")
    return result


def mapping(value: Any, where: str) -> Mapping[str, Any]:
    """``value`` if it is a mapping, else ``FileFormatError``."""
    if not isinstance(value, Mapping):
        raise FileFormatError(f"{where}: expected keys with values, got {type(value).__name__}")
    return value


def entry(values: Any, key: str, where: str) -> Any:
    """The value of a key that must be there; the error names file, place and key."""
    if key not in mapping(values, where):
        raise FileFormatError(
            f"{where}: the key {key!r} is missing; found {', '.join(map(str, values)) or 'none'}"
        )
    return values[key]


def read_mask(path: Path, image_size: tuple[int, int]) -> Tensor:
    """A mask image (h, w) as bool, True where it is at least half white.

    Raises:
        MissingFileError: there is no such file.
        FileFormatError: it cannot be read as an image, or has another size than the camera's images.
    """
    check_file(path, "a mask image")
    pixels = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if pixels is None:
        raise FileFormatError(f"{path}: not an image that OpenCV can read (a mask was expected)")
    if tuple(pixels.shape) != image_size:
        raise FileFormatError(
            f"{path}: the camera's images are {image_size[0]} x {image_size[1]} (height x width), this mask is "
            f"{pixels.shape[0]} x {pixels.shape[1]}"
        )
    return torch.from_numpy(pixels >= 128)


def widest_angle(camera: Camera, mask: Tensor | None = None) -> float:
    """The largest angle from the axis, in radians, at which a usable pixel of the image looks.

    Formats that do not tell a field of view get it from here. It is as good as the mask: an image without one is
    taken to be usable up to its corners.
    """
    directions, valid = camera.unproject(camera.pixel_grid(torch.float64))
    if mask is not None:
        valid = valid & mask.to(valid.device)
    angles = torch.atan2(directions[..., :2].norm(dim=-1), directions[..., 2])
    return float(torch.where(valid, angles, 0.0).max())


def check_radius(rig: CameraRig, path: Path) -> CameraRig:
    """Warn when the cameras are implausibly near or far: most often a unit is wrong. Returns the rig."""
    if len(rig) > 1:
        radius = float(rig.radius)
        if not 0.005 <= radius <= 5.0:
            warnings.warn(
                f"{path}: the cameras are {radius:.4g} m from their centre on average, which is implausible for a rig "
                "(expected 5 mm to 5 m); check the unit of the translations (translation_unit)",
                stacklevel=3,
            )
    return rig
