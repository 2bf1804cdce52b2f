# SPDX-License-Identifier: Apache-2.0
"""Blender's cameras, as json of the names that their settings have in Blender's Python.

Convention:
    ``cameras`` is name -> settings: ``type`` ``PERSP`` or ``PANO``, of which ``panorama_type`` is
    ``FISHEYE_EQUIDISTANT``, ``FISHEYE_EQUISOLID``, ``FISHEYE_LENS_POLYNOMIAL`` or ``EQUIRECTANGULAR``. Lengths on the
    sensor are millimetres, angles radians. ``matrix_world`` takes Blender's camera coordinates (x right, y up, z back)
    to the scene's, in its units, which by default are metres.

    The image spans [−0.5, w − 0.5]. An equidistant image fills its frame, which stretches it where that is no square.
    The polynomial has the angle θ = −(k0 + k1 r + k2 r² + k3 r³ + k4 r⁴) at r millimetres from the middle. A lens has
    no k0: one of less than a tenth of a pixel, such as Blender's own default has, is left out.

References:
    Blender Manual, "Rendering, Cycles, Object Settings, Cameras"; its source, intern/cycles/blender/camera.cpp and
    intern/cycles/kernel/camera/projection.h.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Calibration
from sphericalvision.cameras.calibration.formats import FileFormat
from sphericalvision.cameras.calibration.keys import Keys
from sphericalvision.cameras.calibration.parsing import (
    errors_of_file,
    focal_lengths,
    numbers,
    size_from_width_height,
)
from sphericalvision.cameras.calibration.poses import OPENGL_FROM_OPENCV, transform_from_rows
from sphericalvision.cameras.models.angle_polynomial import AnglePolynomialCamera
from sphericalvision.cameras.models.equirectangular import EquirectangularCamera
from sphericalvision.cameras.models.fisheye import FisheyeCamera
from sphericalvision.cameras.models.pinhole import PinholeCamera
from sphericalvision.core import FileFormatError, short_repr
from sphericalvision.geometry.panorama import ALL_LATITUDES, ALL_LONGITUDES

_PANORAMAS = ("FISHEYE_EQUIDISTANT", "FISHEYE_EQUISOLID", "FISHEYE_LENS_POLYNOMIAL", "EQUIRECTANGULAR")
_FITS = ("AUTO", "HORIZONTAL", "VERTICAL")
_LARGEST_CONSTANT = 0.1
"""Of a polynomial, in pixels."""


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file has ``cameras`` whose settings have Blender's ``sensor_fit``."""
    cameras = content.get("cameras")
    return isinstance(cameras, dict) and any(
        isinstance(values, dict) and "sensor_fit" in values for values in cameras.values()
    )


def read(content: Keys, calibration: Calibration) -> None:
    """Cameras and poses of a parsed file."""
    cameras = content.inner("cameras")
    for name in cameras:
        lens = cameras.inner(name)
        pose = _pose(lens["matrix_world"], lens.at("matrix_world")) if "matrix_world" in lens else None
        calibration.add(str(name), _camera(lens), lens.where, pose)


def _pose(rows: Any, where: str) -> Tensor:
    """World from camera; the scale of a camera object does not change its picture."""
    if not isinstance(rows, list) or len(rows) != 4:
        raise FileFormatError(f"{where}: expected four rows of four numbers, got {short_repr(rows)}")
    matrix = torch.tensor([numbers(row, where, 4) for row in rows], dtype=torch.float64)
    matrix[:3, :3] /= matrix[:3, :3].norm(dim=0).clamp_min(torch.finfo(matrix.dtype).tiny)
    return transform_from_rows(matrix.flatten().tolist(), where) @ OPENGL_FROM_OPENCV


def _camera(values: Keys) -> Camera:
    kind = values.chosen("type", ("PERSP", "PANO"))
    if kind == "PANO":
        kind = values.chosen("panorama_type", _PANORAMAS)
    height, width = size = _image_size(values)
    center = [(width - 1) / 2, (height - 1) / 2]
    shift = [values.number(key, 0.0) for key in ("shift_x", "shift_y")]
    if kind != "PERSP" and any(shift):
        raise FileFormatError(
            f"{values.at('shift_x', 'shift_y')}: expected 0 of a panoramic camera, got {shift}"
        )
    with errors_of_file(values.where):
        if kind == "EQUIRECTANGULAR":
            return _panorama(values, size)
        if kind == "FISHEYE_EQUIDISTANT":
            view = _view(values)
            focal_length = torch.tensor([width / view, height / view], dtype=torch.float64)
            return FisheyeCamera("equidistant", focal_length, center, size, min(view / 2, math.pi))
        scale, longer = _pixels_per_millimetre(values, size)
        if kind == "PERSP":
            pinhole = _checked(values.number("lens") * scale, values.at("lens"))
            center = [center[0] - shift[0] * longer, center[1] + shift[1] * longer]
            return PinholeCamera(pinhole, center, size)
        view = _view(values)
        if kind == "FISHEYE_EQUISOLID":
            focal_length = _checked(values.number("fisheye_lens") * scale, values.at("fisheye_lens"))
            return FisheyeCamera("equisolid", focal_length, center, size, min(view / 2, math.pi))
        k0, k1, *more = [-values.number(f"fisheye_polynomial_k{power}") for power in range(5)]
        first = values.at("fisheye_polynomial_k1")
        focal = _checked(scale / k1 if k1 else 0.0, f"{first} (negative)")
        if abs(k0 / k1) * scale > _LARGEST_CONSTANT:
            raise FileFormatError(
                f"{values.at('fisheye_polynomial_k0')}: expected 0, as the axis is in the middle, got {-k0:g}, which "
                f"is {abs(k0 / k1) * scale:.2g} pixels"
            )
        try:
            distortion = [value / k1**power for power, value in enumerate(more, start=2)]
        except (OverflowError, ZeroDivisionError) as error:
            raise FileFormatError(
                f"{first}: expected radians a millimetre, got {-k1:g}, whose powers overflow"
            ) from error
        lens = AnglePolynomialCamera(focal, center, distortion, size)
        return lens.with_max_angle(min(view / 2, float(lens.max_angle)))


def _checked(focal_length: float, where: str) -> Tensor:
    return torch.tensor(focal_lengths([focal_length] * 2, where), dtype=torch.float64)


def _image_size(values: Keys) -> tuple[int, int]:
    """(height, width) of the picture that is written."""
    ratio = values.number("resolution_percentage", 100.0) / 100
    sides = [int(values.number(key) * ratio) for key in ("resolution_x", "resolution_y")]
    aspects = [values.number(key) for key in ("pixel_aspect_x", "pixel_aspect_y") if key in values]
    if len(set(aspects)) > 1:
        raise FileFormatError(
            f"{values.at('pixel_aspect_x', 'pixel_aspect_y')}: expected square pixels, got {aspects}"
        )
    return size_from_width_height(sides, values.at("resolution_x", "resolution_y"))


def _pixels_per_millimetre(values: Keys, size: tuple[int, int]) -> tuple[float, int]:
    """Pixels in a millimetre on the sensor, and in the side of the image that the sensor is fitted to."""
    fit = values.chosen("sensor_fit", _FITS)
    height, width = size
    horizontal = fit == "HORIZONTAL" or (fit == "AUTO" and width > height)
    key = "sensor_height" if fit == "VERTICAL" else "sensor_width"
    sensor = values.number(key)
    if not sensor > 0:
        raise FileFormatError(f"{values.at(key)}: expected millimetres above 0, got {sensor:g}")
    side = width if horizontal else height
    return side / sensor, side


def _view(values: Keys) -> float:
    view = values.number("fisheye_fov")
    if not 0 < view <= 10 * math.pi + 1e-6:  # as Blender's slider
        raise FileFormatError(f"{values.at('fisheye_fov')}: expected radians above 0, got {view:g}")
    return view


def _panorama(values: Keys, size: tuple[int, int]) -> Camera:
    """A panorama between the stated longitudes and latitudes."""
    keys = ("longitude_min", "longitude_max", "latitude_min", "latitude_max")
    whole = (*ALL_LONGITUDES, *ALL_LATITUDES)
    west, east, south, north = (values.number(key, value) for key, value in zip(keys, whole, strict=True))
    return EquirectangularCamera(size, latitudes=(south, north), longitudes=(west, east))


FileFormat(
    "blender",
    "Blender cameras as json",
    recognizes_keys=recognizes,
    read_keys=read,
    ignored=r"cameras/.*/(lens|lens_unit|angle(_[xy])?|ortho_scale|clip_\w+|display_\w+|dof|sensor_(width|height|fit)"
    r"|panorama_type|shift_[xy]|fisheye_(fov|lens|polynomial_k\d)|(longitude|latitude)_(min|max))",
).register()
