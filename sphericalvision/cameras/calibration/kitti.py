# SPDX-License-Identifier: Apache-2.0
"""KITTI's ``calib_cam_to_cam.txt``: four pinhole cameras with distortion, and their poses in the frame of the first.

Convention:
    ``K_0x`` and ``D_0x`` are those of the images as taken, of size ``S_0x`` (width, height), with k1 k2 p1 p2 k3;
    ``R_0x`` and ``T_0x`` take coordinates of camera 0 to camera x, in metres. Rectified images are another set of
    cameras, ``P_rect_0x``, which is not read. Camera 0 is called ``cam0``.

References:
    A. Geiger, P. Lenz, C. Stiller, R. Urtasun, "Vision meets robotics: the KITTI dataset", IJRR 32 (2013), section 2.
"""

from __future__ import annotations

import re
from pathlib import Path

from sphericalvision.cameras.calibration.contents import Calibration
from sphericalvision.cameras.calibration.formats import FileFormat
from sphericalvision.cameras.calibration.keys import Keys, check_understood
from sphericalvision.cameras.calibration.lenses import distorted
from sphericalvision.cameras.calibration.parsing import camera_matrix
from sphericalvision.cameras.calibration.poses import transform_from_rotation
from sphericalvision.cameras.calibration.text_files import data_lines, looks_structured
from sphericalvision.core import FileFormatError
from sphericalvision.geometry import invert_transform

KITTI_NAME = "calib_cam_to_cam.txt"
_KEY = re.compile(r"[A-Z][A-Za-z_]*_\d\d:|calib_time:|corner_dist:")


def recognizes(path: Path) -> bool:
    """Whether the first line of data begins with one of KITTI's keys."""
    if looks_structured(path):
        return False
    lines = data_lines(path)
    return bool(lines) and bool(_KEY.fullmatch(lines[0][1][0]))


def read(path: Path, calibration: Calibration) -> None:
    """The cameras of unrectified images and their poses."""
    table = Keys(str(path))
    for line, (label, *words) in data_lines(path):
        if not label.endswith(":") or label[:-1] in table:
            raise FileFormatError(f"{path}, line {line}: expected a key of its own first, got {label!r}")
        table[label[:-1]] = words
    table.forget()
    for index in sorted(key[2:] for key in table if re.fullmatch(r"K_\d\d", key)) or ["00"]:
        plane, _ = camera_matrix(table.numbers(f"K_{index}", 9), table.at(f"K_{index}"))
        numbers = [*plane, *table.numbers(f"D_{index}", 5)]
        camera = distorted("radtan", numbers, table.size(f"S_{index}"), table.at(f"K_{index}"))
        motion = table.numbers(f"R_{index}", 9), table.numbers(f"T_{index}", 3)
        pose = invert_transform(transform_from_rotation(*motion, table.at(f"R_{index}")))
        calibration.add(f"cam{int(index)}", camera, table.at(f"K_{index}"), pose)
    check_understood(table, str(path), r"corner_dist|(S_rect|R_rect|P_rect|P)_\d\d")


FileFormat(
    "kitti",
    f"KITTI {KITTI_NAME}",
    recognizes_file=recognizes,
    read_file=read,
    usual_names=(KITTI_NAME,),
).register()
