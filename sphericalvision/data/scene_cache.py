# SPDX-License-Identifier: Apache-2.0
"""A folder of rendered arrays that any number of processes share, and names for what they depend on."""

from __future__ import annotations

import os
import uuid
import zipfile
from collections.abc import Callable, Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig

__all__ = ["SceneCache", "decode", "encode", "parameter_digest", "rounded"]


class SceneCache:
    """Named sets of arrays in one folder; without a folder nothing is kept.

    Args:
        folder: made if need be, or None.

    Examples:
        >>> cache = SceneCache(None)
        >>> cache.get("room-1", lambda: {"depth": torch.ones(2)})["depth"]
        tensor([1., 1.])
        >>> cache.has("room-1")
        False
    """

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)

    def has(self, name: str) -> bool:
        """Whether the arrays of a name lie in the folder."""
        return self.folder is not None and self._path(self.folder, name).is_file()

    def get(self, name: str, make: Callable[[], Mapping[str, Tensor]]) -> dict[str, Tensor]:
        """Read the arrays of a name; where they are missing or damaged, make them and keep them."""
        if self.folder is None:
            return dict(make())
        path = self._path(self.folder, name)
        arrays = _load(path)
        if arrays is None:
            arrays = dict(make())
            _store(path, arrays)
        return arrays

    @staticmethod
    def _path(folder: Path, name: str) -> Path:
        return folder / f"{name}.npz"


def encode(images: Tensor) -> Tensor:
    """[-1, 1] as bytes 1..255."""
    return (images * 127 + 128).round().clamp(1, 255).to(torch.uint8)


def decode(images: Tensor, seen: Tensor) -> Tensor:
    """Bytes ``(n, 3, *)`` of ``encode`` as [-1, 1], 0 where not ``seen`` ``(n, *)``."""
    return torch.where(seen[:, None], (images.float() - 128) / 127, 0.0)


def parameter_digest(numbers: tuple[object, ...], rig: CameraRig) -> str:
    """Sixteen characters that stand for plain parameters and a rig, the rig by its values and masks."""
    digest = sha256(repr(numbers).encode())
    digest.update(rounded(rig.world_from_camera))
    for name, camera in rig.cameras.items():
        options = [getattr(camera, option) for option in camera.option_names]
        digest.update(repr((camera.model, camera.image_size, options)).encode())
        for parameter in (*camera.intrinsic_names, "max_angle"):
            value = getattr(camera, parameter)
            digest.update(b"" if value is None else rounded(value))
        if name in rig.masks:
            digest.update(rig.masks[name].cpu().numpy().tobytes())
    return digest.hexdigest()[:16]


def rounded(values: Tensor) -> bytes:
    """Numbers as text of five digits: float32 and float64, and other ways to compute them, give the same."""
    flat = values.detach().cpu().double().flatten()
    return " ".join(f"{value:.5g}" for value in torch.where(flat.abs() < 1e-6, 0.0, flat).tolist()).encode()


def _load(path: Path) -> dict[str, Tensor] | None:
    """Stored arrays; None if there are none, or if they were damaged and have to be made anew."""
    try:
        with np.load(path) as stored:
            return {name: torch.from_numpy(stored[name]) for name in stored.files}
    except (FileNotFoundError, EOFError, KeyError, ValueError, zipfile.BadZipFile):
        return None


def _store(path: Path, arrays: Mapping[str, Tensor]) -> None:
    """Write under a name of our own first, so that nobody ever reads half a file."""
    temporary = path.with_name(f".{path.stem}-{uuid.uuid4().hex}.npz")
    try:
        plain: dict[str, Any] = {name: array.numpy() for name, array in arrays.items()}
        np.savez_compressed(temporary, **plain)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
