# SPDX-License-Identifier: Apache-2.0
"""py-OCamCalib's json: one OCam camera, whose axes, signs and powers are not those of OCamCalib's text file.

Convention:
    ``distortion_center`` is (u, v). ``taylor_coefficient`` f, ascending, has a positive first number: the ray of an
    undistorted pixel (x, y) is (x, y, f(ρ)), which is forward. ``stretch_matrix`` [[c, d], [e, 1]] takes (x, y) to
    offsets (u, v), where OCamCalib's affine map takes (row, column). The radius is scaled by c, which brings one into
    the form of the other. ``inverse_poly``, an approximation, is not read: the camera inverts exactly.

    ``extrinsics_t`` are poses of the chessboards, not of the camera. The file does not tell the size of the images.

References:
    https://github.com/jakarto3d/py-OCamCalib; D. Scaramuzza et al., "A flexible technique for accurate omnidirectional
    camera calibration", ICVS 2006.
"""

from __future__ import annotations

from typing import Any

from sphericalvision.cameras.calibration.contents import Calibration
from sphericalvision.cameras.calibration.formats import FileFormat, has_all
from sphericalvision.cameras.calibration.keys import Keys
from sphericalvision.cameras.calibration.ocam_text import make_ocam
from sphericalvision.cameras.calibration.parsing import numbers
from sphericalvision.core import FileFormatError, short_repr


def read(content: Keys, calibration: Calibration) -> None:
    """The camera of a parsed file, called by its ``camera_name``."""
    where, taylor = content.where, content.numbers("taylor_coefficient")
    if not taylor[0] > 0:
        raise FileFormatError(
            f"{where}, taylor_coefficient: expected the first one above 0, got {taylor[0]:g}"
        )
    center = content.numbers("distortion_center", 2)
    c, d, e = _stretch(content.entry("stretch_matrix"), content.at("stretch_matrix"))
    size = calibration.options.given_size(where)
    direct = [-value for value in taylor]
    camera = make_ocam(direct, None, center, [c, d, e], size, content.at("stretch_matrix"), of_columns=True)
    name = content.get("camera_name")
    name = name if isinstance(name, str) and name else calibration.path.stem
    calibration.add(name, camera, where)


def _stretch(rows: Any, where: str) -> tuple[float, float, float]:
    """c, d, e of [[c, d], [e, 1]]."""
    if not isinstance(rows, list) or len(rows) != 2:
        raise FileFormatError(f"{where}: expected [[c, d], [e, 1]], got {short_repr(rows)}")
    (c, d), (e, one) = (numbers(row, where, 2) for row in rows)
    if one != 1 or not c - d * e > 0 or not c > 0:
        raise FileFormatError(f"{where}: expected [[c, d], [e, 1]] with c and c − d·e above 0, got {rows}")
    return c, d, e


FileFormat(
    "py_ocamcalib",
    "py-OCamCalib json",
    recognizes_keys=has_all("taylor_coefficient"),
    read_keys=read,
    ignored=r"valid|inverse_poly|extrinsics_t\w*|img_path|\w*_?images?_path",
).register()
