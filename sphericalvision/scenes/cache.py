# SPDX-License-Identifier: Apache-2.0
"""A folder of rendered arrays that any number of processes share, and images as bytes."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from sphericalvision.io.files import atomic_write

__all__ = ["ArrayCache", "decode", "encode"]

Kept = tuple[tuple[int, ...], torch.dtype]


class ArrayCache:
    """Named sets of arrays in one folder; without a folder nothing is kept.

    Args:
        folder: made if need be, or None.
        holds: shape and dtype of each array of a set, by name; a file that holds anything else is made anew. Anything
            will do when not given.

    Examples:
        >>> cache = ArrayCache(None)
        >>> cache.get("room-1", lambda: {"depth": torch.ones(2)})["depth"]
        tensor([1., 1.])
        >>> cache.has("room-1")
        False
    """

    def __init__(self, folder: Path | None, holds: Mapping[str, Kept] | None = None) -> None:
        self.folder, self.holds = folder, None if holds is None else dict(holds)
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)

    def has(self, name: str) -> bool:
        """Whether there is a file for a name."""
        return self.folder is not None and self._path(self.folder, name).is_file()

    def get(self, name: str, make: Callable[[], Mapping[str, Tensor]]) -> dict[str, Tensor]:
        """Read the arrays of a name; where they are missing or damaged, make them and keep them."""
        if self.folder is None:
            return dict(make())
        path = self._path(self.folder, name)
        arrays = _load(path)
        if arrays is None or not self._fit(arrays):
            arrays = dict(make())
            _store(path, arrays)
        return arrays

    def _fit(self, arrays: Mapping[str, Tensor]) -> bool:
        found = {name: (tuple(array.shape), array.dtype) for name, array in arrays.items()}
        return self.holds is None or found == self.holds

    @staticmethod
    def _path(folder: Path, name: str) -> Path:
        return folder / f"{name}.npz"


def encode(images: Float[Tensor, "*images"]) -> UInt8[Tensor, "*images"]:
    """[-1, 1] as bytes 1..255."""
    return (images * 127 + 128).round().clamp(1, 255).to(torch.uint8)


def decode(images: UInt8[Tensor, "n 3 *grid"], seen: Bool[Tensor, " n *grid"]) -> Float[Tensor, "n 3 *grid"]:
    """Bytes ``(n, 3, *)`` of ``encode`` as [-1, 1], 0 where not ``seen`` ``(n, *)``."""
    return torch.where(seen[:, None], (images.float() - 128) / 127, 0.0)


def _load(path: Path) -> dict[str, Tensor] | None:
    """Stored arrays; None if there are none, or if they were damaged and have to be made anew.

    The checksum of each array is verified before anything in it is believed: a damaged header could ask for any
    amount of memory.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return {name.removesuffix(".npy"): _array(archive.read(name)) for name in archive.namelist()}
    except (
        Exception
    ):  # damaged files make zip, zlib and numpy raise nearly anything; all of it means: make it anew
        return None


def _array(content: bytes) -> Tensor:
    return torch.from_numpy(np.lib.format.read_array(io.BytesIO(content), allow_pickle=False))


def _store(path: Path, arrays: Mapping[str, Tensor]) -> None:
    plain: dict[str, Any] = {name: array.numpy() for name, array in arrays.items()}
    with atomic_write(path) as temporary:
        np.savez_compressed(temporary, **plain)
