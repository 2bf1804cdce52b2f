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

from sphericalvision.cameras.calibration.contents import Calibration
from sphericalvision.cameras.calibration.formats import FileFormat, has_all
from sphericalvision.cameras.calibration.keys import Keys
from sphericalvision.cameras.calibration.lenses import Lens, lens_called
from sphericalvision.core import FileFormatError

_LENSES = (
    Lens("ds", "double_sphere", "fx fy cx cy xi alpha"),
    Lens("eucm", "extended_unified", "fx fy cx cy alpha beta"),
    Lens("ucm", "unified", "fx fy cx cy alpha=xi"),
    Lens("kb", "kannala_brandt", "fx fy cx cy k1 k2 k3 k4"),
    Lens("kb8", "kannala_brandt", "fx fy cx cy k1 k2 k3 k4"),
    Lens("radtan", "brown_conrady", "fx fy cx cy k1 k2 k3 p1 p2"),
    Lens("pinhole", "pinhole", "fx fy cx cy"),
)


def read(content: Keys, calibration: Calibration) -> None:
    """The camera of a parsed file."""
    tokens = re.findall(r"[a-z]+\d*", calibration.path.stem.lower())
    named = [lens.name for lens in _LENSES if lens.name in tokens]
    if len(named) != 1:
        raise FileFormatError(
            f"{content.where}: expected a model in the name of the file, as DS.yml: one of "
            f"{', '.join(lens.name for lens in _LENSES)}"
        )
    lens, values = lens_called(_LENSES, named[0]), content.inner("parameter")
    camera = lens.camera(
        [values.number(key) for key in lens.keys],
        content.inner("image").size("width", "height"),
        values.where,
    )
    calibration.add(calibration.path.stem, camera, values.where)


FileFormat(
    "adapter",
    "Fisheye-Calib-Adapter yaml",
    recognizes_keys=has_all("image", "parameter"),
    read_keys=read,
    ignored="",
).register()
