# SPDX-License-Identifier: Apache-2.0
"""Files of scanned points: ``.pcd``, ``.bin``, ``.ply``, ``.npy``, ``.csv`` and ``.xyz``."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.core import FileFormatError, check_file
from sphericalvision.io.arrays import read_npy
from sphericalvision.io.comments import FIRST, warn_of_comments
from sphericalvision.io.files import read_bytes, read_text
from sphericalvision.io.ply_header import read_ply_header

POINT_SUFFIXES = (".pcd", ".bin", ".ply", ".npy", ".csv", ".xyz")

_AXES = ("x", "y", "z")
FARTHEST = 1e7
"""Metres from the origin of a scan's coordinates: what is farther is no scan, in national and geocentric grids, too."""

WIDEST = 500.0
"""Metres along an axis from the middle of a scan to half of its points; of a square kilometre they are 350."""

MOST_COLUMNS = 16
"""Of a row of an array of points: x, y, z, and what scanners add (colour, normal, time, ring, label)."""
FEWEST_FOR_PERIOD = 100
"""Points, below which chance decides which columns look alike."""
CLEARLY_LESS = 0.8
_COLUMNS_REMEDY = "say how many float32 numbers a point has (columns=), or write float64 as .npy"


def read_points(
    path: str | Path, *, columns: int | None = None, ignore_viewpoint: bool = False
) -> Float[Tensor, "P 3"]:
    """Read scanned points ``(P, 3)``, without those that are not finite.

    What a file stores as float64, or as text, is returned as float64: coordinates of a national grid lose decimetres
    in float32, and are to be moved near the rig first.

    ======== =====================================================================
    suffix   content
    ======== =====================================================================
    ``.pcd`` of the Point Cloud Library, as text or binary; compressed is refused
    ``.bin`` float32 ``(P, columns)``, the first three of which are x, y, z. Without
             ``columns``: 4 with the reflectance, as KITTI has it, and 5 where the
             name ends in ``.pcd.bin``, as nuScenes has it
    ``.ply`` vertices of any PLY
    ``.npy`` an array ``(P, 3)`` to ``(P, 16)``, whose first columns are x, y, z, or
             a structured one with fields of these names
    ``.csv`` text, a point a line, separated by commas, semicolons, tabs or blanks.
    ``.xyz`` x, y, z are the columns of these names where the first line names
             columns, else the first three; lines after ``#`` or ``//`` are comments;
             a count of the points may stand before them
    ======== =====================================================================

    Args:
        path: of the file.
        columns: count of numbers of a point in a ``.bin``, which has no header.
        ignore_viewpoint: take points of a ``.pcd`` as stored even if its line VIEWPOINT holds a pose. Some programs
            have moved the points by that pose, others have not, and the file does not state which.

    Raises:
        MissingFileError: there is no such file.
        FileFormatError: it is damaged, of none of these formats, or its values are none that a scanner gives: points
            farther than 10,000 km, whole numbers, whose unit is unknown, or columns of a ``.bin`` that repeat with
            another period, as of float64 or of a wrong count of columns. Or a ``.pcd`` has a VIEWPOINT.

    Examples:
        >>> np.save("scan.npy", np.ones((2, 3), np.float32))
        >>> read_points("scan.npy").shape
        torch.Size([2, 3])
    """
    path = check_file(path, "scanned points")
    suffix = path.suffix.lower()
    if suffix not in POINT_SUFFIXES:
        raise FileFormatError(f"{path}: expected one of {', '.join(POINT_SUFFIXES)}, got {path.suffix!r}")
    try:
        if suffix == ".bin":
            points = _bin(path, columns)
        elif suffix == ".pcd":
            points = _pcd(path, ignore_viewpoint)
        else:
            points = _READERS[suffix](path)
    except FileFormatError:
        raise
    except Exception as error:  # numpy and trimesh raise whatever they meet in a damaged file
        raise FileFormatError(f"{path}: is damaged, or holds no points ({error!s:.200})") from error
    if points.ndim != 2 or points.shape[1] < 3 or not np.issubdtype(points.dtype, np.number):
        raise FileFormatError(f"{path}: expected points (P, 3), got {points.dtype} {points.shape}")
    if points.shape[1] > MOST_COLUMNS:
        raise FileFormatError(
            f"{path}: expected points (P, 3), one a row, got {points.shape}; transpose them if the rows are x, y, z"
        )
    if points.dtype.kind != "f":
        raise FileFormatError(_whole_numbers(path, str(points.dtype)))
    precision = np.float32 if points.dtype.itemsize <= 4 else np.float64
    coordinates = np.ascontiguousarray(points[:, :3], precision)
    coordinates = coordinates[np.isfinite(coordinates).all(1)]
    if len(coordinates) and (farthest := np.abs(coordinates).max()) > FARTHEST:
        raise FileFormatError(
            f"{path}: a point is {farthest:.3g} m from the origin, which no scan has; expected metres"
            + (f"; {_COLUMNS_REMEDY}" if suffix == ".bin" else "")
        )
    apart = np.abs(coordinates - np.median(coordinates, 0)).max(1) if len(coordinates) else np.zeros(1)
    if (spread := np.median(apart)) > WIDEST:
        warnings.warn(
            f"{path}: half of the points are {spread:.3g} m and more from their middle, beyond what scanners see; "
            "expected metres: divide by 1000 if these are millimetres",
            stacklevel=2,
        )
    if suffix not in (".bin", ".npy"):
        with path.open("rb") as file:
            warn_of_comments(path, file.read(FIRST * FIRST).decode("latin-1").splitlines())
    return torch.from_numpy(coordinates)


def _whole_numbers(path: Path, dtype: str) -> str:
    return (
        f"{path}: expected floating point coordinates in metres, got {dtype}; divide by 1000 if they are millimetres, "
        "and store float32"
    )


def _check_axes(path: Path, names: Iterable[str]) -> None:
    if not {*_AXES} <= {*names}:
        raise FileFormatError(f"{path}: expected points with x, y, z, got {', '.join(names)[:80] or 'none'}")


def _pcd(path: Path, ignore_viewpoint: bool) -> Any:
    content = read_bytes(path)
    head: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in head:
        end = content.find(b"\n", at)
        if end < 0 or at > 10_000:
            raise FileFormatError(f"{path}: a header of PCD ends with a line DATA, and there is none")
        key, *words = content[at:end].decode("ascii", "replace").split() or ["#"]
        head[key], at = words, end + 1
    viewpoint = [float(number) for number in head.get("VIEWPOINT", ())]
    if viewpoint not in ([], [0, 0, 0, 1, 0, 0, 0]) and not ignore_viewpoint:
        raise FileFormatError(
            f"{path}: VIEWPOINT {' '.join(head['VIEWPOINT'])}: expected 0 0 0 1 0 0 0, because a PCD does not state "
            "whether its points are moved by that pose already. Move them if they are not, then "
            f"sed -i 's/^VIEWPOINT.*/VIEWPOINT 0 0 0 1 0 0 0/' {path.name}"
        )
    (kind,) = head["DATA"]
    if kind not in ("ascii", "binary"):
        raise FileFormatError(
            f"{path}: DATA {kind} is not read; pcl_convert_pcd_ascii_binary {path.name} out.pcd 1 writes it as binary"
        )
    counts = [int(word) for word in head.get("COUNT", ["1"] * len(head["FIELDS"]))]
    _check_axes(path, head["FIELDS"])
    letters = {"F": "f", "I": "i", "U": "u"}
    formats = [f"<{letters[t]}{s}" for t, s in zip(head["TYPE"], head["SIZE"], strict=True)]
    number = int(head["POINTS"][0])
    if kind == "ascii":
        indices = [head["FIELDS"].index(axis) for axis in _AXES]
        dtype = np.float64 if all(head["TYPE"][index] == "F" for index in indices) else np.int64
        columns = [sum(counts[:index]) for index in indices]
        points = np.loadtxt(io.BytesIO(content[at:]), dtype, usecols=columns, ndmin=2)
    else:
        names = [f"{name}#{k}" if name not in _AXES else name for k, name in enumerate(head["FIELDS"])]
        fields = [(n, f, (c,)) if c > 1 else (n, f) for n, f, c in zip(names, formats, counts, strict=True)]
        table = np.frombuffer(content, np.dtype(fields), number, at)  # type: ignore[arg-type]
        points = np.stack([table[axis] for axis in _AXES], 1)
    if len(points) != number:
        raise FileFormatError(f"{path}: POINTS says {number}, there are {len(points)}")
    return points


def _bin(path: Path, columns: int | None) -> Any:
    is_nuscenes = path.name.endswith(".pcd.bin")
    width = columns or (5 if is_nuscenes else 4)
    values = np.fromfile(path, "<f4")
    if width < 3 or path.stat().st_size % (4 * width):
        raise FileFormatError(
            f"{path}: {path.stat().st_size:,} bytes are no whole number of points of {width} float32 numbers; "
            f"{_COLUMNS_REMEDY}"
        )
    points = values.reshape(-1, width)
    if columns is None and (period := _period(values, width)) != width:
        raise FileFormatError(
            f"{path}: its numbers repeat every {period}, not every {width}, so that these are no points of {width} "
            f"float32 numbers; {_COLUMNS_REMEDY}"
        )
    return points


def _period(values: Any, width: int) -> int:
    """Period of the columns in a stream of numbers: ``width``, unless another one is clearly better.

    Numbers of one column are of one size: z is within metres, x and y within a hundred, a reflectance within one.
    With the right width the logarithms vary little within a column; with a wrong one each column is a mixture of all.
    The halves of float64 numbers differ most of all, and repeat every 6.
    """
    if len(values) < FEWEST_FOR_PERIOD * width:
        return width
    with np.errstate(invalid="ignore", over="ignore"):
        sizes = np.log(np.abs(np.nan_to_num(values.astype(np.float64), posinf=1e38, neginf=1e38)) + 1e-3)

    def spread(period: int) -> float:
        return float(sizes[: len(sizes) // period * period].reshape(-1, period).var(0).mean())

    best = min((3, 4, 5, 6, 7), key=spread)
    return best if spread(best) < CLEARLY_LESS * spread(width) else width


def _ply(path: Path) -> Any:
    import trimesh  # half a second to import

    header = read_ply_header(path)
    _check_axes(path, vertex := header.properties.get("vertex", {}))
    types = {vertex[axis] for axis in _AXES}
    if integers := sorted(name for name in types if not name.startswith(("float", "double"))):
        raise FileFormatError(_whole_numbers(path, integers[0]))
    # Of a file without a name trimesh opens no texture, wherever it may lie, and waits for no pipe.
    loaded: Any = trimesh.load(io.BytesIO(read_bytes(path)), file_type="ply", process=False)
    header.check_vertices(path, len(loaded.vertices))
    return np.asarray(loaded.vertices)


def _text(path: Path) -> Any:
    lines = [line.strip() for line in read_text(path).splitlines() if line.strip()]
    start = next((at for at, line in enumerate(lines) if re.match(r"[-+.\d]|nan", line)), len(lines))
    points = lines[start:]
    if points and points[0].isdigit():  # a count before the points, as in .pts
        count, points = int(points[0]), points[1:]
        if count != len(points):
            raise FileFormatError(f"{path}, line {start + 1}: expected {count} points, got {len(points)}")
    # Blanks last: in "1,5 2,5 3,5" commas are no separators, and no column is a number then.
    delimiter = next((sign for sign in ";\t," if sign in "".join(points[:1])), None)
    columns = [0, 1, 2]
    for line in lines[:start]:
        header = re.sub(r"[\[(]m[\])]", "", line.lower().lstrip("#/ "))  # metres, as they should be
        separator = delimiter if delimiter and delimiter in header else None
        names = [name.strip(" ,;\"'") for name in header.split(separator)]  # which may hold blanks
        if set(_AXES) <= set(names):
            columns = [names.index(axis) for axis in _AXES]
        elif not line.startswith(("#", "//")) or re.search(r"\bx\s*[\[(]", header):
            raise FileFormatError(f"{path}: expected columns x, y and z in metres, got {line[:80]!r}")
    return np.loadtxt(points, delimiter=delimiter, comments=("#", "//"), usecols=columns, ndmin=2)


def _npy(path: Path) -> Any:
    points = read_npy(path)
    if points.dtype.names is None:
        return points
    _check_axes(path, points.dtype.names)
    return np.stack([points[axis] for axis in _AXES], 1)


_READERS = {".ply": _ply, ".npy": _npy, ".csv": _text, ".xyz": _text}
