# SPDX-License-Identifier: Apache-2.0
"""Textured meshes from files that take turns as scenes, a free place of one for each seed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from hashlib import sha256
from pathlib import Path

from torch import Tensor

from sphericalvision.core import ArgumentError, check_file
from sphericalvision.scenes.rendering.mesh_places import free_place
from sphericalvision.scenes.rendering.mesh_scene import SUFFIXES, MeshScene, read_mesh_scene

__all__ = ["MeshFiles", "mesh_files"]

#: Raised when a seed finds another place in a mesh than before, so that nothing kept of the old one is taken for it.
PLACES = 2


@dataclass(frozen=True)
class MeshFiles:
    """Textured meshes that take turns as scenes.

    Args:
        paths: of the files.
        up: axis that points up in them, ``"y"`` or ``"z"``.
        scale: metres in one unit of the files.
    """

    paths: tuple[Path, ...]
    up: str = "y"
    scale: float = 1.0

    def path(self, seed: int) -> Path:
        """The file of a seed."""
        return self.paths[seed % len(self.paths)]

    def name(self, seed: int) -> str:
        """Name, content and seed, for caches."""
        path = self.path(seed)
        return f"{path.stem}-{_digest(path, self.up, self.scale)}-{seed:08d}"

    def make(self, seed: int, clear_radius: float, center: Tensor | None = None) -> MeshScene:
        """A free place in the mesh of a seed, brought to where the rig's centre is."""
        return free_place(_read(self.path(seed), self.up, self.scale), seed, clear_radius, center)


def mesh_files(mesh: str | Path | list[str], up: str = "y", scale: float = 1.0) -> MeshFiles:
    """The meshes that a path stands for: a file, several, or all files of a folder.

    Args:
        mesh: path, or paths.
        up: axis that points up in the files, ``"y"`` (glTF) or ``"z"``.
        scale: metres in one unit of the files.

    Raises:
        MissingFileError: there is no such file.
        ArgumentError: a folder without a mesh, or no path.
    """
    places = [Path(place) for place in (mesh if isinstance(mesh, list) else [mesh])]
    paths: list[Path] = []
    for place in places:
        found = (
            sorted(p for p in place.iterdir() if p.suffix.lower() in SUFFIXES) if place.is_dir() else [place]
        )
        if not found:
            raise ArgumentError(
                f"mesh: expected meshes ({', '.join(SUFFIXES)}) in the folder {place}, found none"
            )
        paths += [Path(check_file(path, "a mesh")) for path in found]
    if not paths:
        raise ArgumentError("mesh: expected a file, a folder or a list of files, got an empty list")
    return MeshFiles(tuple(paths), up, scale)


@lru_cache(maxsize=2)
def _read(path: Path, up: str, scale: float) -> MeshScene:
    return read_mesh_scene(path, up, scale)


@lru_cache(maxsize=64)
def _digest(path: Path, up: str, scale: float) -> str:
    return sha256(path.read_bytes() + repr((up, scale, PLACES)).encode()).hexdigest()[:8]
