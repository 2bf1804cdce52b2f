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

from sphericalvision.cameras.calibration.contents import Contents, Gathered, Options
from sphericalvision.cameras.calibration.formats import FileFormat, register_format
from sphericalvision.cameras.calibration.keys import Keys, check_understood
from sphericalvision.cameras.calibration.lenses import distorted
from sphericalvision.cameras.calibration.parsing import (
    numbers,
    size_from_width_height,
)
from sphericalvision.cameras.calibration.poses import transform_from_rows
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


def contents(path: Path, options: Options) -> Contents:
    """The cameras of unrectified images and their poses."""
    table = Keys()
    for line, (label, *words) in data_lines(path):
        if not label.endswith(":") or label[:-1] in table:
            raise FileFormatError(f"{path}, line {line}: expected a key of its own first, got {label!r}")
        table[label[:-1]] = (line, words)

    def get(key: str, count: int) -> list[float]:
        if key not in table:
            raise FileFormatError(f"{path}: the key {key!r} is missing; found {', '.join(table) or 'none'}")
        line, words = table[key]
        return numbers(words, f"{path}, line {line}, {key}", count)

    indices = sorted(match[1] for key in table if (match := re.fullmatch(r"K_(\d\d)", key)))
    if not indices:
        raise FileFormatError(f"{path}: the key 'K_00' is missing; found {', '.join(table)}")
    calibration = Gathered(options)
    for index in indices:
        where = f"{path}, line {table[f'K_{index}'][0]}, K_{index}"
        fx, skew, cx, _, fy, cy, *last = get(f"K_{index}", 9)
        if skew or last != [0.0, 0.0, 1.0]:
            raise FileFormatError(f"{where}: expected fx 0 cx 0 fy cy 0 0 1")
        sides = get(f"S_{index}", 2)
        size = size_from_width_height(sides, f"{path}, line {table[f'S_{index}'][0]}, S_{index}")
        camera = distorted("radtan", [fx, fy, cx, cy, *get(f"D_{index}", 5)], size, where)
        turn, place = get(f"R_{index}", 9), get(f"T_{index}", 3)
        rows = [[*turn[3 * row : 3 * row + 3], place[row]] for row in range(3)]
        pose = transform_from_rows(rows, f"{path}, line {table[f'R_{index}'][0]}, R_{index}")
        calibration.add(f"cam{int(index)}", camera, where, invert_transform(pose))
    check_understood(table, str(path), r"corner_dist|(S_rect|R_rect|P_rect|P)_\d\d")
    return calibration.contents


register_format(
    FileFormat(
        "kitti",
        f"KITTI {KITTI_NAME}",
        recognizes_file=recognizes,
        contents_of_file=contents,
        usual_names=(KITTI_NAME,),
    )
)
