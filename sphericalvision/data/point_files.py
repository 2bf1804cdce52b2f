# SPDX-License-Identifier: Apache-2.0
"""Files of scanned points: ``.pcd``, ``.bin``, ``.ply`` and ``.npy``."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.core import FileFormatError, check_file

__all__ = ["POINT_SUFFIXES", "read_points"]

POINT_SUFFIXES = (".pcd", ".bin", ".ply", ".npy")

_COUNTS = ("x", "y", "z")


def read_points(path: str | Path) -> Float[Tensor, "P 3"]:
    """Read scanned points ``(P, 3)`` as float32, without those that are not finite.

    ======== =====================================================================
    suffix   content
    ======== =====================================================================
    ``.pcd`` of the Point Cloud Library, as text or binary; compressed is refused
    ``.bin`` float32 ``(P, 4)``: x, y, z, reflectance, as KITTI has it
    ``.ply`` vertices of any PLY
    ``.npy`` an array ``(P, 3)`` or wider, whose first columns are x, y, z
    ======== =====================================================================

    Raises:
        MissingFileError: there is no such file.
        FileFormatError: it is damaged, or of none of these formats.

    Examples:
        >>> np.save("scan.npy", np.ones((2, 3), np.float32))
        >>> read_points("scan.npy").shape
        torch.Size([2, 3])
    """
    path = check_file(path, "scanned points")
    if path.suffix not in POINT_SUFFIXES:
        raise FileFormatError(f"{path}: expected one of {', '.join(POINT_SUFFIXES)}, got {path.suffix!r}")
    try:
        points = _READERS[path.suffix](path)
    except FileFormatError:
        raise
    except Exception as error:  # numpy and trimesh raise whatever they meet in a damaged file
        raise FileFormatError(f"{path}: cannot be read as points: {error!r:.200}") from error
    if points.ndim != 2 or points.shape[1] < 3 or not np.issubdtype(points.dtype, np.number):
        raise FileFormatError(f"{path}: expected points (P, 3), got {points.dtype} {points.shape}")
    found = torch.from_numpy(np.ascontiguousarray(points[:, :3], np.float32))
    return found[found.isfinite().all(1)]


def _pcd(path: Path) -> Any:
    content = path.read_bytes()
    head: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in head:
        end = content.find(b"\n", at)
        if end < 0 or at > 10_000:
            raise FileFormatError(f"{path}: a header of PCD ends with a line DATA, and there is none")
        key, *words = content[at:end].decode("ascii", "replace").split() or ["#"]
        head[key], at = words, end + 1
    (kind,) = head["DATA"]
    if kind not in ("ascii", "binary"):
        raise FileFormatError(
            f"{path}: DATA {kind} is not read; pcl_convert_pcd_ascii_binary {path.name} out.pcd 1 writes it as binary"
        )
    counts = [int(word) for word in head.get("COUNT", ["1"] * len(head["FIELDS"]))]
    letters = {"F": "f", "I": "i", "U": "u"}
    formats = [f"<{letters[t]}{s}" for t, s in zip(head["TYPE"], head["SIZE"], strict=True)]
    number = int(head["POINTS"][0])
    if kind == "ascii":
        columns = [sum(counts[: head["FIELDS"].index(axis)]) for axis in _COUNTS]
        points = np.loadtxt(io.BytesIO(content[at:]), usecols=columns, ndmin=2)
    else:
        names = [f"{name}#{k}" if name not in _COUNTS else name for k, name in enumerate(head["FIELDS"])]
        fields = [(n, f, (c,)) if c > 1 else (n, f) for n, f, c in zip(names, formats, counts, strict=True)]
        table = np.frombuffer(content, np.dtype(fields), number, at)  # type: ignore[arg-type]
        points = np.stack([table[axis] for axis in _COUNTS], 1)
    if len(points) != number:
        raise FileFormatError(f"{path}: POINTS says {number}, there are {len(points)}")
    return points


def _bin(path: Path) -> Any:
    return np.fromfile(path, "<f4").reshape(-1, 4)


def _ply(path: Path) -> Any:
    import trimesh  # half a second to import

    loaded: Any = trimesh.load(path, process=False)
    return np.asarray(loaded.vertices)


def _npy(path: Path) -> Any:
    return np.load(path, allow_pickle=False)


_READERS = {".pcd": _pcd, ".bin": _bin, ".ply": _ply, ".npy": _npy}
