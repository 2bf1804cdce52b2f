# SPDX-License-Identifier: Apache-2.0
"""Files of the poses of one camera that moves: TUM's, KITTI's, and COLMAP's ``images``.

Convention:
    TUM and KITTI write world-from-camera, COLMAP camera-from-world. Lengths are taken as metres.

References:
    https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats, https://www.cvlibs.net/datasets/kitti/eval_odometry.php,
    https://www.cvlibs.net/datasets/kitti-360/documentation.php, https://colmap.github.io/format.html
"""

from __future__ import annotations

import re
from pathlib import Path

import torch
from torch import Tensor

from sphericalvision.cameras.calibration.colmap_records import images_in
from sphericalvision.cameras.calibration.files import data_lines
from sphericalvision.cameras.calibration.parsing import numbers, view_name
from sphericalvision.cameras.calibration.poses import transform_from_numbers, transform_from_rows
from sphericalvision.cameras.trajectory import Trajectory
from sphericalvision.core import FileFormatError, MissingFileError, check_file
from sphericalvision.geometry import invert_transform

__all__ = ["read_trajectory"]

EXPECTED = (
    "TUM's (time tx ty tz qx qy qz qw), KITTI's (12 numbers, or 16, with or without the number of the image before "
    "them), or images.txt or images.bin of COLMAP"
)


def read_trajectory(path: str | Path) -> Trajectory:
    """Read the poses of one camera that moves, whose format is recognised by its content.

    ========  ==============================================  ================================  =====================
    format    a line                                          pose                              names
    ========  ==============================================  ================================  =====================
    TUM       ``time tx ty tz qx qy qz qw``                   world from camera                 times as they stand
    KITTI     3 or 4 rows of 4 numbers, one after the other   world from camera                 rows from 0
    KITTI-360 the same after the number of the image          world from camera                 numbers of the images
    COLMAP    ``images.txt``, ``images.bin``                  camera from world, inverted here  images without suffix
    ========  ==============================================  ================================  =====================

    Args:
        path: the file, or a folder with COLMAP's ``images``; ``#`` starts a comment.

    Raises:
        MissingFileError: there is nothing at ``path``.
        FileFormatError: it is in none of these formats, or broken; the message names the line.

    Examples:
        >>> _ = Path("way.txt").write_text("0.0 0 0 0 0 0 0 1" + chr(10) + "0.1 0 0 0.5 0 0 0 1")
        >>> read_trajectory("way.txt").positions[1].tolist()
        [0.0, 0.0, 0.5]
    """
    path = Path(path)
    if path.is_dir():
        there = [path / name for name in ("images.bin", "images.txt") if (path / name).is_file()]
        if not there:
            raise MissingFileError(
                f"{path}: expected images.txt or images.bin in this folder, or a file of poses"
            )
        path = there[0]
    check_file(path, "poses of a moving camera")
    if path.suffix == ".bin":
        return _of_images(path)
    lines = data_lines(path)
    if not lines:
        raise FileFormatError(f"{path}: no pose in it; expected {EXPECTED}")
    count = len(lines[0][1])
    if path.name == "images.txt" or count == 10:
        return _of_images(path)
    if count not in (8, 12, 13, 16, 17):
        raise FileFormatError(f"{path}, line {lines[0][0]}: {count} words; expected {EXPECTED}")
    names, poses = [], []
    for row, (line, words) in enumerate(lines):
        where = f"{path}, line {line}"
        values = numbers(words, where, count)
        if count == 8:
            names.append(words[0])
            poses.append(transform_from_numbers([values[7], *values[4:7]], values[1:4], where))
        else:
            names.append(str(row) if count % 4 == 0 else words[0])
            poses.append(transform_from_rows(values[count % 4 :], where))
    return _trajectory(names, poses, path)


def _of_images(path: Path) -> Trajectory:
    """Of COLMAP's images, in the order of their names."""
    named: list[tuple[str, Tensor]] = []
    for image in images_in(path):
        name = view_name(image.name).rsplit("/", 1)[-1]
        named.append(
            (name, invert_transform(transform_from_numbers(image.pose[:4], image.pose[4:], image.where)))
        )
    if not named:
        raise FileFormatError(f"{path}: no image in it")
    named.sort(key=lambda pair: [(len(part), part) for part in re.split(r"(\d+)", pair[0])])
    return _trajectory([name for name, _ in named], [pose for _, pose in named], path)


def _trajectory(names: list[str], poses: list[Tensor], path: Path) -> Trajectory:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise FileFormatError(f"{path}: two poses are called {name}; expected one a time or image")
        seen.add(name)
    return Trajectory(names, torch.stack(poses))
