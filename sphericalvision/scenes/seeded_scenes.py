# SPDX-License-Identifier: Apache-2.0
"""Which scene a seed stands for, and whether a rig fits into it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from hashlib import sha256
from pathlib import Path

from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError, check_choice, check_file
from sphericalvision.scenes.carriers import CARRIERS, with_carrier
from sphericalvision.scenes.recipes import kind_of, make_scene
from sphericalvision.scenes.rendering.mesh_places import free_place
from sphericalvision.scenes.rendering.mesh_scene import SUFFIXES, MeshScene, read_mesh_scene
from sphericalvision.scenes.rendering.scene import Scene

__all__ = ["GENERATION", "HELD_OUT_SEED", "NATURAL_MIN_DEPTH", "MeshFiles", "SeededScenes", "mesh_files"]

#: Raised whenever the recipes or the renderer change what a seed looks like, so that old caches are not read.
GENERATION = 2
#: Scenes of this seed and above are kept for comparing methods: no training, validation or test of one uses them.
HELD_OUT_SEED = 10_000_000
#: Least depth, and free space around the rig, of scenes at their natural scale (metres).
NATURAL_MIN_DEPTH, CLEAR_RADIUS = 0.55, 0.6
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


@dataclass(frozen=True)
class SeededScenes:
    """Scenes around a rig, one for each seed.

    Args:
        rig: unbatched.
        kind: of ``make_scene``, or of ``kind_of`` a mixture.
        min_depth: least depth that the network tells apart, metres. Scenes scale with it: 0.55 is natural size; meshes
            have the size that they have.
        meshes: of which scenes are made in place of a kind.
        carrier: what carries the rig and is in view, see ``with_carrier``; nothing when not given.

    Raises:
        ArgumentError: unknown kind or carrier, a carrier in a mesh, or cameras farther from the rig's centre than the
            space that scenes keep free.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> SeededScenes(ring_rig(4), "mixed").name(7)
        'floating-00000007'
    """

    rig: CameraRig
    kind: str
    min_depth: float = NATURAL_MIN_DEPTH
    meshes: MeshFiles | None = None
    carrier: str | None = None

    def __post_init__(self) -> None:
        if self.meshes is None:
            kind_of(self.kind, 0)
        if self.carrier is not None:
            check_choice("carrier", self.carrier, CARRIERS)
            if self.meshes is not None:
                raise ArgumentError(
                    "carrier: what carries the rig can be put into generated scenes, not into meshes"
                )
        if not self.min_depth > 0:
            raise ArgumentError(f"min_depth: expected metres above 0, got {self.min_depth}")
        radius = (self.rig.positions - self.rig.center).norm(dim=-1).max().item()
        if radius >= CLEAR_RADIUS * self.scale:
            raise ArgumentError(
                f"rig: its cameras lie up to {radius:.2f} m from its centre, but scenes of min_depth "
                f"{self.min_depth} keep only {CLEAR_RADIUS * self.scale:.2f} m free; give a min_depth above "
                f"{radius / CLEAR_RADIUS * NATURAL_MIN_DEPTH:.2f}"
            )

    @property
    def scale(self) -> float:
        """Of the scenes' lengths."""
        return self.min_depth / NATURAL_MIN_DEPTH

    def name(self, seed: int) -> str:
        """Kind and seed of a scene, as they stand in ``frame``."""
        if self.meshes is not None:
            return self.meshes.name(seed)
        kind = kind_of(self.kind, seed)
        return f"{kind}-{seed:08d}" if self.carrier is None else f"{kind}-{self.carrier}-{seed:08d}"

    def make(self, seed: int) -> Scene | MeshScene:
        """The scene of a seed."""
        if self.meshes is not None:
            return self.meshes.make(seed, CLEAR_RADIUS * self.scale, self.rig.center)
        kind = kind_of(self.kind, seed)
        scene = make_scene(kind, seed, center=self.rig.center, scale=self.scale, clear_radius=CLEAR_RADIUS)
        return scene if self.carrier is None else with_carrier(scene, self.carrier, self.rig, seed).scene
