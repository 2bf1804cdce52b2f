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

import torch

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Contents, Options
from sphericalvision.cameras.calibration.files import data_lines, looks_structured
from sphericalvision.cameras.calibration.formats import FileFormat, register_format
from sphericalvision.cameras.calibration.keys import Keys, check_understood
from sphericalvision.cameras.calibration.parsing import (
    errors_of_file,
    focal_lengths,
    numbers,
    size_from_width_height,
)
from sphericalvision.cameras.calibration.poses import transform_from_rows
from sphericalvision.cameras.calibration.visible_part import bounded
from sphericalvision.cameras.models.brown_conrady import BrownConradyCamera
from sphericalvision.core import FileFormatError
from sphericalvision.geometry import invert_transform

__all__ = ["contents", "recognizes"]

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
    cameras: dict[str, Camera] = {}
    poses = []
    for index in indices:
        where = f"{path}, line {table[f'K_{index}'][0]}, K_{index}"
        fx, skew, cx, _, fy, cy, *last = get(f"K_{index}", 9)
        if skew or last != [0.0, 0.0, 1.0]:
            raise FileFormatError(f"{where}: expected fx 0 cx 0 fy cy 0 0 1")
        focal_length = torch.tensor(focal_lengths([fx, fy], where), dtype=torch.float64)
        size = size_from_width_height(
            get(f"S_{index}", 2), f"{path}, line {table[f'S_{index}'][0]}, S_{index}"
        )
        with errors_of_file(where):
            camera = BrownConradyCamera(focal_length, [cx, cy], get(f"D_{index}", 5), size)
        cameras[f"cam{int(index)}"] = bounded(camera, options.max_angle, where)
        rotation, position = get(f"R_{index}", 9), get(f"T_{index}", 3)
        rows = [[*rotation[3 * row : 3 * row + 3], position[row]] for row in range(3)]
        where = f"{path}, line {table[f'R_{index}'][0]}, R_{index}"
        poses.append(invert_transform(transform_from_rows(rows, where)))
    check_understood(table, str(path), r"corner_dist|(S_rect|R_rect|P_rect|P)_\d\d")
    return Contents(cameras, torch.stack(poses))


register_format(
    FileFormat(
        "kitti",
        f"KITTI {KITTI_NAME}",
        recognizes_file=recognizes,
        contents_of_file=contents,
        usual_names=(KITTI_NAME,),
    )
)
