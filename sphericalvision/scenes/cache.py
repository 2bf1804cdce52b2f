# SPDX-License-Identifier: Apache-2.0
"""A folder of rendered arrays that any number of processes share, and images as bytes."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from sphericalvision.io.files import atomic_write

Kept = tuple[tuple[int | None, ...], torch.dtype]
"""Shape and type of an array; sizes that are None are any."""


class ArrayCache:
    """Named sets of arrays in one folder; without a folder nothing is kept.

    Args:
        folder: made if need be, or None.
        holds: shape and dtype of each array of a set, by name; a file that holds anything else is made anew. Anything
            will do when not given, and any size that is None.
        compress: whether files are smaller, for more time to write and read them.

    Examples:
        >>> cache = ArrayCache(None)
        >>> cache.get("room-1", lambda: {"depth": torch.ones(2)})["depth"]
        tensor([1., 1.])
        >>> cache.has("room-1")
        False
    """

    def __init__(
        self, folder: Path | None, holds: Mapping[str, Kept] | None = None, compress: bool = True
    ) -> None:
        self.folder, self.holds = folder, None if holds is None else dict(holds)
        self.compress = compress
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)

    def has(self, name: str) -> bool:
        """Whether there is a file for a name."""
        return self.folder is not None and (self.folder / f"{name}.npz").is_file()

    def get(self, name: str, make: Callable[[], Mapping[str, Tensor]]) -> dict[str, Tensor]:
        """Read the arrays of a name; where they are missing or damaged, make them and keep them."""
        if self.folder is None:
            return dict(make())
        path = self.folder / f"{name}.npz"
        arrays = _load(path)
        if arrays is None or not self._fit(arrays):
            arrays = dict(make())
            save: Callable[..., None] = np.savez_compressed if self.compress else np.savez
            with atomic_write(path) as temporary:
                save(temporary, **{key: array.numpy() for key, array in arrays.items()})
        return arrays

    def _fit(self, arrays: Mapping[str, Tensor]) -> bool:
        if self.holds is None:
            return True
        return set(arrays) == set(self.holds) and all(
            array.dtype == dtype
            and array.ndim == len(shape)
            and all(size in (None, actual) for size, actual in zip(shape, array.shape, strict=True))
            for array, (shape, dtype) in ((arrays[name], self.holds[name]) for name in self.holds)
        )


def encode(images: Float[Tensor, "*images"]) -> UInt8[Tensor, "*images"]:
    """Values of [0, 1] as bytes, as image files hold them.

    Examples:
        >>> encode(torch.tensor([0.0, 0.5, 1.0])), decode(encode(torch.tensor([0.2])))
        (tensor([  0, 128, 255], dtype=torch.uint8), tensor([0.2000]))
    """
    return (images * 255).round().clamp(0, 255).to(torch.uint8)


def decode(images: UInt8[Tensor, "*images"]) -> Float[Tensor, "*images"]:
    """Bytes of ``encode`` as values of [0, 1]."""
    return images.float() / 255


def _load(path: Path) -> dict[str, Tensor] | None:
    """Stored arrays; None if there are none, or if they were damaged and have to be made anew.

    The checksum of each array is verified before anything in it is believed: a damaged header could ask for any
    amount of memory.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return {name.removesuffix(".npy"): _array(archive.read(name)) for name in archive.namelist()}
    except Exception:
        # Damaged files make zip, zlib and numpy raise nearly anything; all of it means: make it anew.
        return None


def _array(content: bytes) -> Tensor:
    return torch.from_numpy(np.lib.format.read_array(io.BytesIO(content), allow_pickle=False))
