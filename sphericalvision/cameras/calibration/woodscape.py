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
from torch import Tensor

from sphericalvision.cameras.calibration.contents import Calibration
from sphericalvision.cameras.calibration.formats import FileFormat
from sphericalvision.cameras.calibration.keys import Keys
from sphericalvision.cameras.calibration.parsing import errors_of_file
from sphericalvision.cameras.calibration.poses import transform_from_numbers
from sphericalvision.cameras.calibration.text_files import load
from sphericalvision.cameras.models.radial_polynomial import RadialPolynomialCamera
from sphericalvision.io.files import by_numbers


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file has an ``intrinsic`` with WoodScape's keys."""
    values = content.get("intrinsic")
    return "intrinsic" in content and (
        "extrinsic" in content or (isinstance(values, dict) and ("model" in values or "cx_offset" in values))
    )


def read(content: Keys, calibration: Calibration) -> None:
    """The camera of a parsed file, called by its ``name``, and its pose if the file has one."""
    values = content.inner("intrinsic")
    values.chosen("model", ("radial_poly",), default="radial_poly")
    powers = range(1, values.count("poly_order", 20, default=4) + 1)
    coefficients = torch.tensor([values.number(f"k{power}") for power in powers], dtype=torch.float64)
    height, width = size = values.size("width", "height")
    center = [values.number("cx_offset") + width / 2 - 0.5, values.number("cy_offset") + height / 2 - 0.5]
    aspect = values.number("aspect_ratio", 1.0)
    with errors_of_file(values.where):
        camera = RadialPolynomialCamera(coefficients, center, aspect, size)
    name = str(content.get("name") or calibration.path.stem)
    pose = _pose(content.inner("extrinsic")) if "extrinsic" in content else None
    calibration.add(name, camera, values.where, pose)


def _pose(values: Keys) -> Tensor:
    x, y, z, w = values.numbers("quaternion", 4)
    where = f"{values.at('quaternion')} (x, y, z, w)"
    return transform_from_numbers([w, x, y, z], values.numbers("translation", 3), where)


def files_of_rig(folder: Path) -> list[Path]:
    """The folder's json files of this format, one for each camera."""
    return [path for path in sorted(folder.glob("*.json"), key=by_numbers) if _is_woodscape(path)]


def _is_woodscape(path: Path) -> bool:
    content = load(path)
    return isinstance(content, dict) and recognizes(content)


FileFormat(
    "woodscape",
    "WoodScape json",
    recognizes_keys=recognizes,
    read_keys=read,
    ignored="",
    files_of_rig=files_of_rig,
).register()
