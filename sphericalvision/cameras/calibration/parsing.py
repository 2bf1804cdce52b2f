# SPDX-License-Identifier: Apache-2.0
"""Numbers, keys and units of calibration files, checked, with errors that name file and key."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

from sphericalvision.cameras.checks import PLAUSIBLE
from sphericalvision.cameras.registry import model_meant
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import FileFormatError, SphericalVisionError, short_repr

METRES_PER_UNIT = {"m": 1.0, "cm": 0.01, "mm": 0.001}
FARTHEST = 1e8
"""Metres from the origin; no place on Earth is as far from its centre."""
LARGEST_SIDE = 100_000
"""Of an image, in pixels; more is taken for a damaged file."""


def numbers(values: Any, where: str, count: int | None = None) -> list[float]:
    """``values`` as finite floats, ``count`` of them if given; ``where`` names file and line or key in errors.

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
        if any(isinstance(value, bool) for value in values):
            raise ValueError
        result = [float(value) for value in values]
    except (TypeError, ValueError, OverflowError):
        raise FileFormatError(f"{where}: expected numbers, got {short_repr(values)}") from None
    if not all(math.isfinite(value) for value in result):
        raise FileFormatError(f"{where}: expected finite numbers, got {short_repr(values)}; correct the file")
    return result


def matrix(value: Any, where: str, count: int | None = None) -> list[float]:
    """The numbers of a matrix, row by row: a FileStorage matrix, nested lists, or one list."""
    if isinstance(value, Mapping):
        missing = [key for key in ("rows", "cols", "data") if key not in value]
        if missing:
            raise FileFormatError(
                f"{where}: expected a matrix of rows, cols and data, {missing[0]} is missing"
            )
        rows, columns = numbers([value["rows"], value["cols"]], f"{where}, rows and cols", 2)
        data = value["data"]
        elements = [] if rows * columns == 0 else numbers(data, f"{where}, data")
        if rows * columns != len(elements):
            raise FileFormatError(
                f"{where}: announces {rows:g} x {columns:g} numbers but holds {len(elements)}; is the file truncated?"
            )
    else:
        if isinstance(value, list) and all(isinstance(row, list) for row in value):
            value = [number for row in value for number in row]
        elements = [] if value == [] else numbers(value, where)
    if count is not None and len(elements) != count:
        raise FileFormatError(f"{where}: expected {count} numbers, got {len(elements)}")
    return elements


def camera_matrix(
    elements: list[float], where: str, has_skew: bool = False
) -> tuple[list[float], float | None]:
    """fx, fy, cx and cy of a camera matrix, row by row, and its skew, of models that have one; None is no skew."""
    fx, skew, cx, zero, fy, cy, *last = elements
    focal_lengths([fx, fy], where)  # first: a camera that was not calibrated has zeros in ROS's messages
    if zero or last != [0.0, 0.0, 1.0]:
        raise FileFormatError(f"{where}: expected the rows fx 0 cx, 0 fy cy and 0 0 1, got {elements}")
    is_skewed = abs(skew) > 1e-9 * fx
    if is_skewed and not has_skew:
        raise FileFormatError(
            f"{where}: a skew of {skew:g} is for fisheye and omnidirectional cameras; OpenCV's others have none"
        )
    return [fx, fy, cx, cy], skew if is_skewed else None


def focal_lengths(values: list[float], where: str) -> list[float]:
    """``values`` if all are positive, else ``FileFormatError``."""
    if not all(value > 0 for value in values):
        raise FileFormatError(f"{where}: expected positive focal lengths in pixels, got {values}")
    return values


def size_from_width_height(values: Any, where: str) -> tuple[int, int]:
    """(height, width) from a file's width and height.

    Examples:
        >>> size_from_width_height([640, 480.0], "camera.yaml, resolution")
        (480, 640)
    """
    width, height = numbers(values, where, 2)
    if not all(side == int(side) and 1 <= side <= LARGEST_SIDE for side in (width, height)):
        raise FileFormatError(
            f"{where}: expected the width and height of the image in pixels, got {width:g} and {height:g}"
        )
    return int(height), int(width)


def chosen(value: Any, choices: Iterable[str], where: str) -> str:
    """``value`` if it is one of the words ``choices``, else ``FileFormatError``; ``where`` names file and key."""
    names = tuple(choices)
    if not isinstance(value, str) or value not in names:
        raise FileFormatError(f"{where}: expected {_listed(names)}, got {short_repr(value)}")
    return value


def chosen_model(value: Any, choices: Iterable[str], where: str) -> str:
    """``value`` or the one of a format's names of models that it is a synonym of, else ``FileFormatError``."""
    names = tuple(choices)
    if isinstance(value, str) and value not in names:
        value = next((word for word in names if model_meant(word) == model_meant(value)), value)
    return chosen(value, names, where)


def _listed(words: tuple[str, ...]) -> str:
    return " or ".join(words) if len(words) < 3 else f"one of {', '.join(words)}"


_IMAGE = re.compile(
    r"(?i)\.(png|jpe?g|tiff?|bmp|webp|exr|hdr|p[gnp]m|jp2|jxl|gif|hei[cf]|avif|dng|raw|insp|cr[23]|nef|arw|orf|rw2)$"
)


def view_name(file: Any) -> str:
    """The name of a view by its image: the way to it without the suffix, in whatever system it was written.

    Examples:
        >>> view_name(r".\\images\\front.000.png"), view_name("./rig.000")
        ('images/front.000', 'rig.000')
    """
    name = str(PurePosixPath(_IMAGE.sub("", str(file).strip().replace("\\", "/"))))
    return name if name.strip("/.") else ""


@contextmanager
def errors_of_file(where: str) -> Iterator[None]:
    """Errors about arguments become errors about the file that the arguments came from."""
    try:
        yield
    except FileFormatError:
        raise
    except SphericalVisionError as error:
        raise FileFormatError(f"{where}: {error}") from None


def check_radius(rig: CameraRig, path: Path) -> CameraRig:
    """Warn when the cameras are implausibly near or far: most often a unit is wrong. Returns the rig."""
    if len(rig) > 1:
        radius = float(rig.radius)
        if not PLAUSIBLE[0] <= radius <= PLAUSIBLE[1]:
            warnings.warn(
                f"{path}: the cameras are {radius:.4g} m from their centre on average, which is implausible for a rig "
                "(expected 5 mm to 5 m); check the unit of the translations (translation_unit)",
                stacklevel=3,
            )
    return rig
