# SPDX-License-Identifier: Apache-2.0
"""WoodScape's json: the image radius as a polynomial of the angle from the axis, one camera a file.

Convention:
    The principal point is (cx_offset + width / 2 - 0.5, cy_offset + height / 2 - 0.5), the centre of the top-left pixel
    being (0, 0), as the data set's ``calibration_readme.txt`` states. ``aspect_ratio`` stretches v. The quaternion is
    (x, y, z, w); with the translation in metres it takes camera coordinates to the vehicle's (ISO 8855: x forward,
    y left, z up, from the ground below the rear axle), and that frame is the rig's world.

References:
    S. Yogamani et al., "WoodScape: a multi-task, multi-camera fisheye dataset for autonomous driving", ICCV 2019.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from sphericalvision.cameras.calibration.contents import Contents, Options
from sphericalvision.cameras.calibration.files import load
from sphericalvision.cameras.calibration.formats import FileFormat, register_format
from sphericalvision.cameras.calibration.parsing import (
    chosen,
    entry,
    errors_of_file,
    mapping,
    number,
    numbers,
    size_from_width_height,
)
from sphericalvision.cameras.calibration.poses import transform_from_numbers
from sphericalvision.cameras.calibration.visible_part import bounded
from sphericalvision.cameras.models.radial_polynomial import RadialPolynomialCamera
from sphericalvision.core import FileFormatError

__all__ = ["contents", "files_of_rig", "recognizes"]


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file has an ``intrinsic`` with WoodScape's keys."""
    values = content.get("intrinsic")
    return "intrinsic" in content and (
        "extrinsic" in content or (isinstance(values, dict) and ("model" in values or "cx_offset" in values))
    )


def contents(content: dict[str, Any], path: Path, options: Options) -> Contents:
    """The camera of a parsed file, called by its ``name``, and its pose if the file has one."""
    where = f"{path}, intrinsic"
    values = mapping(entry(content, "intrinsic", str(path)), where)
    chosen(values.get("model", "radial_poly"), ("radial_poly",), f"{where}, model")
    order = number(values, "poly_order", where) if "poly_order" in values else 4
    if order != int(order) or not 1 <= order <= 20:
        raise FileFormatError(f"{where}, poly_order: expected a count from 1 to 20, got {order:g}")
    coefficients = [number(values, f"k{power}", where) for power in range(1, int(order) + 1)]
    height, width = size_from_width_height(
        [entry(values, "width", where), entry(values, "height", where)], f"{where}, width and height"
    )
    center = [
        number(values, "cx_offset", where) + width / 2 - 0.5,
        number(values, "cy_offset", where) + height / 2 - 0.5,
    ]
    aspect = number(values, "aspect_ratio", where) if "aspect_ratio" in values else 1.0
    with errors_of_file(where):
        polynomial = torch.tensor(coefficients, dtype=torch.float64)
        camera = RadialPolynomialCamera(polynomial, center, aspect, (height, width))
    camera = bounded(camera, options.max_angle, where)
    name = str(content.get("name") or path.stem)
    return Contents({name: camera}, _pose(content, path) if "extrinsic" in content else None)


def _pose(content: dict[str, Any], path: Path) -> torch.Tensor:
    where = f"{path}, extrinsic"
    values = content["extrinsic"]
    x, y, z, w = numbers(entry(values, "quaternion", where), f"{where}, quaternion", 4)
    translation = numbers(entry(values, "translation", where), f"{where}, translation", 3)
    return transform_from_numbers([w, x, y, z], translation, f"{where}, quaternion (x, y, z, w)")[None]


def files_of_rig(folder: Path) -> list[Path]:
    """The folder's json files of this format, one for each camera."""
    return [path for path in sorted(folder.glob("*.json")) if _is_woodscape(path)]


def _is_woodscape(path: Path) -> bool:
    content = load(path)
    return isinstance(content, dict) and recognizes(content)


register_format(
    FileFormat(
        "woodscape",
        "WoodScape json",
        recognizes_keys=recognizes,
        contents_of_keys=contents,
        ignored="",
        files_of_rig=files_of_rig,
    )
)
