# SPDX-License-Identifier: Apache-2.0
"""Settings of stella_vslam and OpenVSLAM: one camera, its keys flat (``Camera.fx``) or in a section ``Camera``.

Convention:
    ``fisheye`` is OpenCV's fisheye, ``perspective`` OpenCV's five coefficients, ``radial_division`` one λ, and
    ``equirectangular`` a whole panorama. Poses are not part of the settings.

References:
    S. Sumikura, M. Shibuya, K. Sakurada, "OpenVSLAM: A Versatile Visual SLAM Framework", ACM MM 2019, and the page
    "Parameters" of stella_vslam's documentation.
"""

from __future__ import annotations

from typing import Any

from sphericalvision.cameras.calibration.contents import Calibration
from sphericalvision.cameras.calibration.formats import FileFormat
from sphericalvision.cameras.calibration.keys import SETTINGS, Keys
from sphericalvision.cameras.calibration.lenses import Lens, lens_called

_LENSES = (
    Lens("fisheye", "kannala_brandt", "fx fy cx cy k1 k2 k3 k4"),
    Lens("perspective", "brown_conrady", "fx fy cx cy k1 k2 p1 p2 k3"),
    Lens("radial_division", "division", "fx fy cx cy distortion=k1"),
    Lens("equirectangular", "equirectangular", ""),
)
_SECTION = "Camera"


def recognizes(content: dict[str, Any]) -> bool:
    """Whether ``Camera`` has two of model, columns and rows, in a section or flat; the third is then asked for."""
    section = content.get(_SECTION)
    keys = section if isinstance(section, dict) else {str(key).removeprefix("Camera."): 0 for key in content}
    return sum(key in keys for key in ("model", "cols", "rows")) > 1


def read(content: Keys, calibration: Calibration) -> None:
    """The camera of a parsed file, called by its ``name``, or as the file is."""
    values, prefix = (content.inner(_SECTION), "") if _SECTION in content else (content, "Camera.")
    lens = lens_called(_LENSES, values.model(f"{prefix}model", [lens.name for lens in _LENSES]))
    size = values.size(f"{prefix}cols", f"{prefix}rows")
    intrinsics = [values.number(prefix + key) for key in lens.keys]
    name = str(values.get(f"{prefix}name") or calibration.path.stem)
    calibration.add(name, lens.camera(intrinsics, size, values.where), values.where)


FileFormat(
    "stella_vslam",
    "stella_vslam's and OpenVSLAM's settings",
    recognizes_keys=recognizes,
    read_keys=read,
    ignored=SETTINGS
    + r"(?!Camera).*|Camera[./](setup|color_order|fps|focal_x_baseline|depth_threshold|depthmap_factor)",
).register()
