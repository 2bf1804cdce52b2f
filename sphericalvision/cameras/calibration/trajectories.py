# SPDX-License-Identifier: Apache-2.0
"""Files of the poses of one camera that moves: TUM's, EuRoC's, KITTI's, and COLMAP's ``images``.

Convention:
    TUM, EuRoC and KITTI write world-from-camera, COLMAP camera-from-world. Lengths are taken as metres. TUM's
    quaternions end in w, EuRoC's and TUM-VI's begin with it: a header that names the columns decides their order.

References:
    https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats, https://www.cvlibs.net/datasets/kitti/eval_odometry.php,
    https://www.cvlibs.net/datasets/kitti-360/documentation.php, https://colmap.github.io/format.html
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import torch
from torch import Tensor

from sphericalvision.cameras.calibration.colmap_records import images_in, transform_of
from sphericalvision.cameras.calibration.keys import check_one_set
from sphericalvision.cameras.calibration.parsing import FARTHEST, numbers, view_name
from sphericalvision.cameras.calibration.poses import transform_from_numbers, transform_from_rows
from sphericalvision.cameras.trajectory import Trajectory
from sphericalvision.core import FileFormatError, MissingFileError, check_file
from sphericalvision.geometry import invert_transform
from sphericalvision.io.comments import METRES, warn_of_comments
from sphericalvision.io.files import read_text
from sphericalvision.io.times import in_order, seconds

EXPECTED = (
    "TUM's (time tx ty tz qx qy qz qw), a table whose header names these columns (EuRoC's data.csv), KITTI's "
    "(12 numbers, or 16, with or without the number of the image before them), or images.txt or images.bin of COLMAP"
)

COLUMNS = ("time", "x", "y", "z", "qw", "qx", "qy", "qz")
TUM = ("time", "x", "y", "z", "qx", "qy", "qz", "qw")
"""The order of ``COLUMNS`` in a line of TUM's, which has no header."""
_TIMES = ("time", "seconds", "nanoseconds")
_HEADERS = {
    "time": re.compile(r"(?i)time|t|(time)?_?stamp"),
    "seconds": re.compile(r"(?i)\S*(time|stamp)[_./]?(s|secs?|seconds)|secs?|seconds"),
    "nanoseconds": re.compile(r"(?i)\S*(time|stamp)[_./]?n(ano)?(s|secs?|seconds)|n(ano)?(secs?|seconds)"),
} | {
    name: re.compile(rf"(?i)(q|q_|q_\w+_|quat(ernion)?[_.]?|orientation[_.]?){name[1]}(_world_\w+)?")
    if name.startswith("q")
    else re.compile(rf"(?i)(t|t_|p|p_|p_\w+_|pos(ition)?[_.]?|translation[_.]?)?{name}(_world_\w+)?")
    for name in COLUMNS[1:]
}
"""How headers call the columns: ``p_RS_R_x``, ``tx`` and ``x`` are one."""
_SETS = re.compile(
    r"(?i)(\w*_)?(u*id|cam(era)?|sensor|session|rig|device|robot|agent|body|bad|valid|lost|status)"
)
"""Columns by which the lines may be poses of several cameras, or not all of them good."""
_CONVENTIONS = {
    r"world[ _-]*(to|2)[ _-]*cam|\bw2c\b|\bT_?(c|cam|camera)_?(w|world)\b|\bcam(era)?_from_world": "camera to world",
    r"\bq?w[\s,]+q?x[\s,]+q?y[\s,]+q?z\b(?!.*camera_id)": "qx qy qz qw, or a header of all columns",
}
"""What a comment says of poses, and what is expected."""
_NO_METRES = re.compile(r"(?i)[xyz]\"?\s*[\[(]\s*([ckm]m)\s*[\])]")
"""Of a header, the unit behind a position."""


def read_trajectory(path: str | Path) -> Trajectory:
    """Read the poses of one camera that moves, whose format is recognised by its content.

    ========  ==============================================  ================================  =====================
    format    a line                                          pose                              names
    ========  ==============================================  ================================  =====================
    TUM       ``time tx ty tz qx qy qz qw``                   world from camera                 times as they stand
    EuRoC     a header of such names, in any order            world from camera                 times as they stand
    KITTI     3 or 4 rows of 4 numbers, one after the other   world from camera                 rows from 0
    KITTI-360 the same after the number of the image          world from camera                 numbers of the images
    COLMAP    ``images.txt``, ``images.bin``                  camera from world, inverted here  images without suffix
    ========  ==============================================  ================================  =====================

    Whole seconds and nanoseconds in two columns, as ROS has them, are one time, ``12.000000500``.

    Args:
        path: the file, or a folder with COLMAP's ``images``; ``#`` starts a comment.

    Raises:
        MissingFileError: there is nothing at ``path``.
        FileFormatError: it is in none of these formats, or broken; the message names the line. Or a folder has two
            files of COLMAP's that differ.

    Examples:
        >>> _ = Path("way.txt").write_text("0.0 0 0 0 0 0 0 1" + chr(10) + "0.1 0 0 0.5 0 0 0 1")
        >>> read_trajectory("way.txt").positions[1].tolist()
        [0.0, 0.0, 0.5]
    """
    path = Path(path)
    if path.is_dir():
        files = [path / name for name in ("images.bin", "images.txt") if (path / name).is_file()]
        if not files:
            names = ", ".join(sorted(entry.name for entry in path.iterdir()))
            raise MissingFileError(
                f"{path}: expected images.txt or images.bin in this folder, or a file of poses, got {names:.200}"
            )
        trajectory, *others = map(_images, files)
        for other in others:
            pair = trajectory.world_from_camera, other.world_from_camera
            if trajectory.names != other.names or not torch.allclose(*pair, rtol=1e-7, atol=1e-5):
                raise FileFormatError(f"{path}: images.bin and images.txt hold different poses; name one")
        return trajectory
    check_file(path, "poses of a moving camera")
    if path.suffix == ".bin":
        return _images(path)
    header, lines = _table(path)
    if not lines:
        raise FileFormatError(f"{path}: no pose in it; expected {EXPECTED}")
    number, first = lines[0]
    where, count = f"{path}, line {number}", len(first)
    if path.name == "images.txt" or (count == 10 and header is None):
        return _images(path)
    if header is None and count == 8:
        header = list(TUM)
        if numbers(first, where)[4:] == [1.0, 0.0, 0.0, 0.0]:
            warnings.warn(
                f"{where}: 1 0 0 0 is half a turn about x, as qx comes first where no header says otherwise; "
                "if qw does, put a line before all others: # time tx ty tz qw qx qy qz",
                stacklevel=2,
            )
    if header is not None:
        return _columns_of_poses(header, lines, path)
    if count not in (12, 13, 16, 17):
        columns = [text for text in re.split("[,;]", " ".join(first)) if text.strip()]
        if len(columns) > count:
            raise FileFormatError(
                f"{where}: {len(columns)} columns separated by commas or semicolons, and no line that names them; put "
                f"one before all others, such as # {','.join(TUM)}"
            )
        raise FileFormatError(f"{where}: {count} values; expected {EXPECTED}")
    return _matrices(lines, path)


def _columns_of_poses(header: list[str], lines: list[tuple[int, list[str]]], path: Path) -> Trajectory:
    """TUM's and EuRoC's: time, position and quaternion, in the order of the header."""
    number, count = lines[0][0], len(lines[0][1])
    if len(header) > count:
        raise FileFormatError(
            f"{path}, line {number}: {count} values, but the header names {len(header)} columns ({' '.join(header)}); "
            "correct the header, which decides their order, or remove it"
        )
    order = [header.index(name) for name in COLUMNS[1:]]
    used = {*order, *(header.index(name) for name in _TIMES if name in header)}
    for column, name in enumerate(header):
        texts = [entries[column] for _, entries in lines if column < len(entries)]
        if _SETS.fullmatch(name):
            check_one_set(name, texts, str(path))
        if name.lower() == "scale" and set(numbers(texts, f"{path}, scale")) != {1.0}:
            raise FileFormatError(
                f"{path}: expected 1 in the column scale, got {texts[0]}; move the positions"
            )
    names, poses = [], []
    for number, entries in lines:
        where = f"{path}, line {number}"
        values = numbers([e if k in used else 0 for k, e in enumerate(entries)], where, count)
        position, quaternion = ([values[column] for column in group] for group in (order[:3], order[3:]))
        names.append(_time(header, entries, values, where))
        poses.append(transform_from_numbers(quaternion, position, where))
    return _trajectory(names, poses, path, are_times=True)


def _matrices(lines: list[tuple[int, list[str]]], path: Path) -> Trajectory:
    """KITTI's: 3 or 4 rows of 4 numbers in a line, after the number of the image or without it."""
    count = len(lines[0][1])
    has_number = count % 4 == 1
    names, poses = [], []
    for row, (number, entries) in enumerate(lines):
        values = numbers(entries, f"{path}, line {number}", count)
        names.append(entries[0] if has_number else str(row))
        poses.append(transform_from_rows(values[has_number:], f"{path}, line {number}"))
    return _trajectory(names, poses, path, names_are_rows=not has_number)


def _table(path: Path) -> tuple[list[str] | None, list[tuple[int, list[str]]]]:
    """The names of the columns if a line names time, place and turn, and the lines of values with their numbers.

    Commas and semicolons separate values where there is such a header; where there is none their order is not known,
    and they stay.
    """
    header, lines = None, []
    rows = [(line, _columns(line)) for line in read_text(path).splitlines()]
    warn_of_comments(path, [line if names is None else "" for line, names in rows], METRES | _CONVENTIONS)
    for number, (line, names) in enumerate(rows, start=1):
        if names is not None:
            if header not in (None, names):
                raise FileFormatError(
                    f"{path}, line {number}: a second header that differs from the first; expected one order in a file"
                )
            if unit := _NO_METRES.search(line):
                raise FileFormatError(
                    f"{path}, line {number}: expected positions in metres, the header says {unit[1]}; bring them to "
                    "metres, and correct it"
                )
            header = names
            continue
        text = line.split("#")[0]
        if re.search(r"\d,\d+[;\s]+[-+\d]", text):
            raise FileFormatError(
                f"{path}, line {number}: decimals have commas; write them with points, 0.25 in place of 0,25"
            )
        if words := (text.split() if header is None else re.sub("[,;]", " ", text).split()):
            lines.append((number, words))
    return header, lines


def _time(header: list[str], words: list[str], values: list[float], where: str) -> str:
    """The time as it stands, or of whole seconds and nanoseconds beside them."""
    column, *more = [header.index(name) for name in _TIMES if name in header]
    if "time" in header or not more:
        return words[column]
    whole, rest = values[column], values[more[0]]
    if rest >= 1e9:  # all of the time once more
        return words[more[0]]
    if whole % 1 or rest < 0:
        raise FileFormatError(
            f"{where}: expected whole seconds and nanoseconds of 0 or more beside them, got {words[column]} and "
            f"{words[more[0]]}; leave the header one column of time"
        )
    return f"{whole:.0f}.{rest:09.0f}"


def _columns(line: str) -> list[str] | None:
    """What the words of a header stand for, a name of ``_HEADERS`` or as they are; None of any other line."""
    tokens = re.sub(r"[\[(][^][()]*[])]|[#,;\"]", " ", line).split()
    names = [
        next((to for to, pattern in _HEADERS.items() if pattern.fullmatch(word)), word) for word in tokens
    ]
    if not all(names.count(name) == 1 for name in COLUMNS[1:]):
        return None
    if not any(name in names for name in _TIMES):  # ts, frame, or whatever it is called by
        is_other = names[0] in COLUMNS or "CAMERA_ID" in names  # COLMAP's comment on its own columns
        names = [] if is_other else ["time", *names[1:]]
    return names or None


def _images(path: Path) -> Trajectory:
    """COLMAP's images, in the order of their names."""
    named: list[tuple[str, Tensor]] = []
    folders: dict[str, str] = {}
    for image in images_in(path):
        folder, _, name = view_name(image.name).rpartition("/")
        if folders.setdefault(name, folder) != folder:
            raise FileFormatError(
                f"{image.where}: {name} is in {folders[name] or '.'} and in {folder or '.'}: images of a rig of "
                "several cameras; expected poses of one camera, or of the rig itself, a line 'time x y z qx qy qz qw' "
                "for each moment"
            )
        named.append((name, invert_transform(transform_of(image.pose, image.where))))
    if not named:
        raise FileFormatError(f"{path}: no image in it")
    order = {name: place for place, name in enumerate(in_order(name for name, _ in named))}
    named.sort(key=lambda pair: order[pair[0]])
    return _trajectory([name for name, _ in named], [pose for _, pose in named], path)


def _trajectory(
    names: list[str], poses: list[Tensor], path: Path, names_are_rows: bool = False, are_times: bool = False
) -> Trajectory:
    """Of poses with names that differ, and tell times that differ where they are times."""
    seen: set[str | float] = set()
    for name, time in zip(names, seconds(names) if are_times else names, strict=True):
        key = name if time is None else time
        if key in seen:
            raise FileFormatError(f"{path}: two poses are called {name}; expected one a time or image")
        seen.add(key)
    transforms = torch.stack(poses)
    if (transforms[:, :3, 3].abs() > FARTHEST).any():
        raise FileFormatError(f"{path}: a pose is more than {FARTHEST:g} m from the origin; expected metres")
    return Trajectory(names, transforms, names_are_rows)
