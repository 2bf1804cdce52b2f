# SPDX-License-Identifier: Apache-2.0
"""Fisheye-Calib-Adapter's YAML: one camera, whose model is told by the name of the file (``DS.yml``).

Convention:
    ``image`` has width and height, ``parameter`` the numbers of the model: DS and EUCM as in their papers, UCM with
    α = ξ / (1 + ξ) and focal lengths f = γ / (1 + ξ), KB and RadTan as OpenCV's. OCam files are refused: nothing says
    on what their affine part acts.

References:
    S. Lee, "Fisheye-Calib-Adapter: an easy tool for fisheye camera model conversion", arXiv 2407.12405.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from sphericalvision.cameras.calibration.contents import Contents, Options
from sphericalvision.cameras.calibration.formats import FileFormat, register_format
from sphericalvision.cameras.calibration.lenses import Lens, lens_called
from sphericalvision.cameras.calibration.parsing import entry, number, size_from_width_height
from sphericalvision.cameras.calibration.visible_part import bounded
from sphericalvision.core import FileFormatError

__all__ = ["contents", "recognizes"]

_LENSES = (
    Lens("ds", "double_sphere", "fx fy cx cy xi alpha"),
    Lens("eucm", "extended_unified", "fx fy cx cy alpha beta"),
    Lens("ucm", "unified", "fx fy cx cy alpha=xi"),
    Lens("kb", "kannala_brandt", "fx fy cx cy k1 k2 k3 k4"),
    Lens("kb8", "kannala_brandt", "fx fy cx cy k1 k2 k3 k4"),
    Lens("radtan", "brown_conrady", "fx fy cx cy k1 k2 k3 p1 p2"),
    Lens("pinhole", "pinhole", "fx fy cx cy"),
)


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file has ``image`` and ``parameter``."""
    return "image" in content and "parameter" in content


def contents(content: dict[str, Any], path: Path, options: Options) -> Contents:
    """The camera of a parsed file.

    Raises:
        FileFormatError: the name of the file tells no model; keys alone do not.
    """
    words = re.findall(r"[a-z]+\d*", path.stem.lower())
    named = [lens.name for lens in _LENSES if lens.name in words]
    if len(named) != 1:
        raise FileFormatError(
            f"{path}: expected a model in the name of the file, as DS.yml: one of {', '.join(x.name for x in _LENSES)}"
        )
    lens, where = lens_called(_LENSES, named[0]), f"{path}, parameter"
    found = [number(content["parameter"], key, where) for key in lens.keys]
    if lens.name == "ucm":
        if not 0 <= found[4] < 1:
            raise FileFormatError(f"{where}, alpha: expected a number in [0, 1), got {found[4]:g}")
        xi = found[4] / (1 - found[4])
        found = [found[0] * (1 + xi), found[1] * (1 + xi), *found[2:4], xi]
    sides = [entry(content["image"], key, f"{path}, image") for key in ("width", "height")]
    camera = lens.camera(found, size_from_width_height(sides, f"{path}, image"), where)
    return Contents({path.stem: bounded(camera, options.max_angle, where)})


register_format(
    FileFormat(
        "adapter",
        "Fisheye-Calib-Adapter yaml",
        recognizes_keys=recognizes,
        contents_of_keys=contents,
        ignored="",
    )
)
