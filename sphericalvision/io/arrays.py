# SPDX-License-Identifier: Apache-2.0
"""Arrays of numpy from files that somebody else wrote: no pickles, and no more memory than a file may ask for."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from sphericalvision.core import FileFormatError, check_file

MAX_BYTES = 2**28
"""Of all arrays of a file together: a level 10 icosphere with directions, inverse depth and confidence has 210 MB."""


def read_npy(path: str | Path) -> npt.NDArray[Any]:
    """Read the array of a ``.npy``, which has as many bytes as its header declares.

    Raises:
        MissingFileError: there is no such file.
        FileFormatError: it is no array, is cut short, or holds Python objects.
    """
    path = check_file(path, "an array of numpy")
    with path.open("rb") as file:
        try:
            declared = _declared_bytes(file)
            if declared > path.stat().st_size:
                raise ValueError(
                    f"its header declares {declared:,} bytes, the file has {path.stat().st_size:,}"
                )
            file.seek(0)
            array: npt.NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
            return _native(array)
        except Exception as error:  # numpy raises whatever it meets in a damaged file
            raise FileFormatError(f"{path}: is no array of numpy, or is damaged ({error})") from error


def read_npz(
    path: str | Path, keys: Sequence[str], most_bytes: int = MAX_BYTES, what: str = "arrays of numpy"
) -> dict[str, npt.NDArray[Any]]:
    """Read these arrays of a ``.npz``; what they unpack to is looked up before anything is unpacked.

    Raises:
        MissingFileError: there is no such file.
        FileFormatError: it is none, lacks an array, is damaged, or unpacks to more than ``most_bytes``.

    Examples:
        >>> np.savez("two.npz", a=np.zeros(3), b=np.ones(2))
        >>> read_npz("two.npz", ["b"])["b"]
        array([1., 1.])
    """
    path = check_file(path, what)
    try:
        with zipfile.ZipFile(path) as archive:
            members = {key: f"{key}.npy" for key in keys}
            total = 0
            for member in members.values():
                with archive.open(member) as file:  # the zip and the array in it may claim different sizes
                    total += max(archive.getinfo(member).file_size, _declared_bytes(file))
            if total > most_bytes:
                raise ValueError(
                    f"{', '.join(keys)} unpack to {total:,} bytes, at most {most_bytes:,} are read"
                )
        with np.load(path, allow_pickle=False) as arrays:
            return {key: _native(arrays[key]) for key in keys}
    except Exception as error:  # and so do zipfile and zlib
        raise FileFormatError(
            f"{path}: expected {', '.join(keys)}: {what}; it has others, or is damaged ({error})"
        ) from error


def _native(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """The array in the byte order of this machine, the only one that torch takes."""
    return array.astype(array.dtype.newbyteorder("="), copy=False)


def _declared_bytes(file: IO[bytes]) -> int:
    """Bytes of the array whose header comes next in a file."""
    major, _ = np.lib.format.read_magic(file)  # type: ignore[no-untyped-call]
    if major == 1:
        shape, _, dtype = np.lib.format.read_array_header_1_0(file)
    else:
        shape, _, dtype = np.lib.format.read_array_header_2_0(file)
    return int(math.prod(shape)) * int(dtype.itemsize)
