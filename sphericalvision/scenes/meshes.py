# SPDX-License-Identifier: Apache-2.0
"""Textured meshes from files that take turns as scenes, a free place of one for each seed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from hashlib import sha256
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sphericalvision.core import ArgumentError, check_file
from sphericalvision.icosphere import Icosphere
from sphericalvision.scenes.rendering.mesh_scene import SUFFIXES, MeshScene, read_mesh_scene

#: Raised when a seed finds another place in a mesh than before, or a mesh other colours, so that nothing kept of the
#: old ones is taken for it.
PLACES = 3


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
        return f"{self.content(self.path(seed))}-{seed:08d}"

    def content(self, path: Path) -> str:
        """Name and content of one of the files, with axis and scale."""
        return f"{path.stem}-{_digest(path, self.up, self.scale)}"

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
    sources = [Path(place) for place in (mesh if isinstance(mesh, list) else [mesh])]
    paths: list[Path] = []
    for place in sources:
        files = (
            sorted(p for p in place.iterdir() if p.suffix.lower() in SUFFIXES) if place.is_dir() else [place]
        )
        if not files:
            raise ArgumentError(
                f"mesh: expected meshes ({', '.join(SUFFIXES)}) in the folder {place}, found none"
            )
        paths += [Path(check_file(path, "a mesh")) for path in files]
    if not paths:
        raise ArgumentError("mesh: expected a file, a folder or a list of files, got an empty list")
    return MeshFiles(tuple(paths), up, scale)


@lru_cache(maxsize=2)
def _read(path: Path, up: str, scale: float) -> MeshScene:
    return read_mesh_scene(path, up, scale)


@lru_cache(maxsize=64)
def _digest(path: Path, up: str, scale: float) -> str:
    return sha256(path.read_bytes() + repr((up, scale, PLACES)).encode()).hexdigest()[:8]


TRIES = 500
#: Share of all directions in which something must be, for a place to count as inside of what was scanned.
ENCLOSED = 0.4
#: Share of the directions more than 30° down in which something must be, for a place to count as above ground.
GROUNDED = 0.9


class PlacedMesh(MeshScene):
    """A mesh moved so that a place in it lies where the rig is, and turned about the vertical there.

    Args:
        mesh: shared by all places in it; nothing is copied.
        place: ``(3,)`` metres in the mesh's own world.
        yaw: radians by which the rig looks further to the right.
        center: ``(3,)`` where the rig's centre is, metres; the origin when not given.

    Examples:
        >>> import trimesh
        >>> from sphericalvision.scenes import ray_depth
        >>> room = MeshScene(trimesh.creation.box((4.0, 3.0, 6.0)))  # doctest: +SKIP
        >>> to_the_right = PlacedMesh(room, torch.tensor([1.0, 0.0, 0.0]), 0.0)  # doctest: +SKIP
        >>> ray_depth(to_the_right, torch.zeros(3), torch.tensor([[1.0, 0.0, 0.0]]))  # doctest: +SKIP
        tensor([1.])
    """

    def __init__(
        self,
        mesh: MeshScene,
        place: Float[Tensor, " 3"],
        yaw: float = 0.0,
        center: Float[Tensor, " 3"] | None = None,
    ) -> None:
        self.mesh, self.place = mesh, place
        self.center = torch.zeros(3) if center is None else center.detach().cpu().float()
        self.exposure, self.background = mesh.exposure, mesh.background
        sin, cos = math.sin(yaw), math.cos(yaw)
        self.mesh_from_world = torch.tensor([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])

    def trace(
        self, origin: Float[Tensor, " 3"], directions: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, " n"], Int[Tensor, " n"]]:
        """First triangle along each ray; see ``MeshScene.trace``."""
        return self.mesh.trace(self._point(origin), directions @ self.mesh_from_world.T)

    def light(self, origin: Float[Tensor, " 3"], directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Linear colours ``(n, 3)`` along rays ``(n, 3)``; see ``MeshScene.light``."""
        return self.mesh.light(self._point(origin), directions @ self.mesh_from_world.T)

    def _point(self, origin: Tensor) -> Tensor:
        return self.place + self.mesh_from_world @ (origin.detach().cpu().float() - self.center)


def free_place(
    mesh: MeshScene, seed: int, clear_radius: float = 0.6, center: Float[Tensor, " 3"] | None = None
) -> PlacedMesh:
    """A place in a mesh, drawn at random, that is free around it and has something on enough sides.

    Places are drawn evenly from the box that bounds the mesh; the first is taken that has no triangle nearer than
    ``clear_radius`` in any of 642 directions, hits one in two of five, and in nine of ten of those that look more than
    30° down: a rig stands above ground, not under it or beside the mesh. Where no place drawn has ground, as among
    objects alone, the first that has the other two is taken. The yaw is drawn as well.

    Args:
        mesh: y down, metres.
        seed: the same seed finds the same place.
        clear_radius: metres.
        center: ``(3,)`` where the rig's centre is, metres; the origin when not given.

    Raises:
        ArgumentError: there is no such place among 500 that are drawn.
    """
    generator = torch.Generator().manual_seed(seed)
    vertices = torch.from_numpy(mesh.vertices).float()
    low, high = vertices.amin(0), vertices.amax(0)
    directions = Icosphere(3).vertices
    down = directions[:, 1] > 0.5
    nearest, groundless = 0.0, None
    for _ in range(TRIES):
        point = low + (high - low) * torch.rand(3, generator=generator)
        yaw = 2 * math.pi * torch.rand((), generator=generator).item()
        distance, _ = mesh.trace(point, directions)
        clear = distance.min().item()
        met = distance.isfinite().float()
        if clear >= clear_radius and met.mean() >= ENCLOSED:
            placed = PlacedMesh(mesh, point, yaw, center)
            if met[down].mean() >= GROUNDED:
                return placed
            groundless = groundless or placed
        nearest = max(nearest, clear if math.isfinite(clear) else 0.0)
    if groundless is not None:
        return groundless
    size = " x ".join(f"{side:.2f}" for side in (high - low).tolist())
    raise ArgumentError(
        f"mesh: no place for a rig with {clear_radius:.2f} m of free space around it, {nearest:.2f} m was the most; "
        f"the mesh is {size} m large (x, y, z): is its scale in metres, and its up axis right?"
    )
