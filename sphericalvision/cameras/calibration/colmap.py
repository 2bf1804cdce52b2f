# SPDX-License-Identifier: Apache-2.0
"""COLMAP's ``cameras.txt``: intrinsics of any number of cameras, by number, without poses.

Convention:
    In COLMAP the centre of the top-left pixel is (0.5, 0.5), here it is (0, 0): half a pixel is taken off principal
    points in reading, and added in writing. Camera 1 is called ``cam1``.

References:
    https://colmap.github.io/cameras.html, https://colmap.github.io/format.html
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path

import torch

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Contents, Options
from sphericalvision.cameras.calibration.files import data_lines, looks_structured
from sphericalvision.cameras.calibration.formats import FileFormat, register_format
from sphericalvision.cameras.calibration.parsing import (
    errors_of_file,
    focal_lengths,
    numbers,
    size_from_width_height,
)
from sphericalvision.cameras.calibration.supported_models import (
    check_holds,
    numbers_of,
    without_trailing_zeros,
)
from sphericalvision.cameras.calibration.visible_part import bounded
from sphericalvision.cameras.models.brown_conrady import BrownConradyCamera
from sphericalvision.cameras.models.kannala_brandt import KannalaBrandtCamera
from sphericalvision.cameras.models.pinhole import PinholeCamera
from sphericalvision.core import ArgumentError, FileFormatError
from sphericalvision.io.files import atomic_write

__all__ = ["contents", "recognizes", "write_colmap"]

_PARAMETERS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
}


def recognizes(path: Path) -> bool:
    """Whether the first line of data is a number and then the name of a model in capitals."""
    if looks_structured(path):
        return False
    lines = data_lines(path)
    return bool(lines) and len(lines[0][1]) > 1 and bool(re.fullmatch(r"[A-Z][A-Z_0-9]+", lines[0][1][1]))


def contents(path: Path, options: Options) -> Contents:
    """The cameras of the file.

    Raises:
        FileFormatError: a line is broken, or its model is not known; the message names the line.
    """
    cameras: dict[str, Camera] = {}
    for line, words in data_lines(path):
        where = f"{path}, line {line}"
        if len(words) < 4:
            raise FileFormatError(
                f"{where}: expected CAMERA_ID MODEL WIDTH HEIGHT and parameters, got {' '.join(words)}"
            )
        name = f"cam{words[0]}"
        if not words[0].isdigit() or name in cameras:
            raise FileFormatError(f"{where}: expected a camera number of its own first, got {words[0]!r}")
        cameras[name] = bounded(_camera(words, where), options.max_angle, where)
    if not cameras:
        raise FileFormatError(f"{path}: no camera in it")
    return Contents(cameras)


def _camera(words: list[str], where: str) -> Camera:
    model = words[1]
    if model not in _PARAMETERS:
        raise FileFormatError(f"{where}: expected a model among {', '.join(_PARAMETERS)}, got {model}")
    size = size_from_width_height(words[2:4], f"{where}, width and height")
    names = _PARAMETERS[model].split()
    found = numbers(words[4:], f"{where}, {model} ({' '.join(names)})", len(names))
    focal = 1 if names[0] == "f" else 2
    checked = focal_lengths([found[0], found[focal - 1]], where)
    focal_length = torch.tensor(checked, dtype=torch.float64)
    center = [found[focal] - 0.5, found[focal + 1] - 0.5]
    coefficients = found[focal + 2 :]
    with errors_of_file(where):
        if model in ("SIMPLE_PINHOLE", "PINHOLE"):
            return PinholeCamera(focal_length, center, size)
        coefficients += [0.0] * (4 - len(coefficients))
        if model.endswith("FISHEYE"):
            return KannalaBrandtCamera(focal_length, center, coefficients, size, math.pi)
        return BrownConradyCamera(focal_length, center, coefficients, size)


def write_colmap(cameras: Camera | Mapping[str, Camera], path: str | Path) -> None:
    """Write one camera or several as ``cameras.txt``; ``cam7`` becomes camera 7, other names are numbered from 1.

    Fields of view are not part of the format.

    Raises:
        ArgumentError: COLMAP has no such model; the message names formats that have it.
    """
    named = cameras if isinstance(cameras, Mapping) else {"cam1": cameras}
    if not named:
        raise ArgumentError("cameras: expected at least one camera, got none")
    known = all(re.fullmatch(r"cam\d+", name) for name in named)
    lines = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"]
    for place, (name, camera) in enumerate(named.items(), start=1):
        lines.append(f"{int(name[3:]) if known else place} {_line(camera)}")
    with atomic_write(path) as unfinished:
        unfinished.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _line(camera: Camera) -> str:
    check_holds("colmap", camera)
    assert isinstance(camera, PinholeCamera | BrownConradyCamera | KannalaBrandtCamera)
    coefficients: list[float] = []
    model = "PINHOLE"
    if isinstance(camera, KannalaBrandtCamera):
        model, coefficients = "OPENCV_FISHEYE", numbers_of(camera.distortion)
    elif isinstance(camera, BrownConradyCamera):
        coefficients = without_trailing_zeros(numbers_of(camera.distortion), (4, 8), "distortion")
        model = "OPENCV" if len(coefficients) == 4 else "FULL_OPENCV"
    height, width = camera.image_size
    center = [value + 0.5 for value in numbers_of(camera.principal_point)]
    values = [*numbers_of(camera.focal_length), *center, *coefficients]
    return f"{model} {width} {height} {' '.join(map(repr, values))}"


register_format(
    FileFormat(
        "colmap",
        "COLMAP cameras.txt",
        recognizes_file=recognizes,
        contents_of_file=contents,
        usual_names=("cameras.txt",),
        models=("pinhole", "brown_conrady", "kannala_brandt"),
        write_camera=write_colmap,
    )
)
