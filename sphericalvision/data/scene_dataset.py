# SPDX-License-Identifier: Apache-2.0
"""Rendered scenes as training samples on the icosphere, made on the fly and kept in a cache if wanted."""

from __future__ import annotations

import os
import uuid
import zipfile
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.data.scenes import KINDS, make_scene, ray_depth, render_rig
from sphericalvision.icosphere import Icosphere

__all__ = ["SceneDataset"]

#: Raised whenever the recipes or the renderer change what a seed looks like, so that old caches are not read.
GENERATION = 2
#: Least depth, and free space around the rig, of scenes at their natural scale (metres).
NATURAL_MIN_DEPTH, CLEAR_RADIUS = 0.55, 0.6


class SceneDataset(Dataset[dict[str, Any]]):
    """Scenes of consecutive seeds, seen by a rig and brought onto the icosphere.

    Sample ``i`` is the scene of seed ``first_seed + i``, so data sets with disjoint seeds are disjoint.
    Its entries: ``images`` ``(n, 3, V_level)`` in [-1, 1], 0 outside the field of view; ``inverse_depth``
    ``(V_{level-2},)`` in 1/m, exact along the rays from the rig's centre, 0 at infinity; ``valid``
    ``(V_{level-2},)``; ``rig``; ``frame``.

    Args:
        num_scenes: number of samples.
        rig: unbatched; images have the cameras' own sizes before they are brought onto the icosphere.
        level: of the icosphere that carries the images; depth is two levels below.
        kind: ``"room"``, ``"floating"``, or ``"mixed"`` (even seeds are rooms, odd ones floating objects).
        first_seed: seed of sample 0.
        samples_per_pixel: rays through each pixel.
        min_depth: least depth that the network tells apart, metres. Scenes scale with it: 0.55 is natural size.
        antialias: average images over the area between vertices, for images much finer than the icosphere.
        cache_dir: folder where rendered samples are kept. Each set of parameters has its own folder in
            there, and any number of processes may share it.

    Raises:
        ArgumentError: unknown kind, level below 2, fewer than one scene, a seed below 0, or cameras farther
            from the rig's centre than the space that scenes keep free.

    Examples:
        >>> from sphericalvision.cameras import CameraRig, FisheyeCamera
        >>> camera = FisheyeCamera.from_field_of_view((32, 32), 3.8)
        >>> rig = CameraRig({"front": camera}, torch.eye(4)[None])
        >>> sample = SceneDataset(1, rig, level=3)[0]
        >>> sample["images"].shape, sample["inverse_depth"].shape
        (torch.Size([1, 3, 642]), torch.Size([42]))
    """

    def __init__(
        self,
        num_scenes: int,
        rig: CameraRig,
        level: int,
        kind: str = "room",
        first_seed: int = 0,
        samples_per_pixel: int = 1,
        min_depth: float = NATURAL_MIN_DEPTH,
        antialias: bool = False,
        cache_dir: str | os.PathLike[str] | None = None,
    ) -> None:
        check_choice("kind", kind, (*KINDS, "mixed"))
        for name, value, least in (
            ("num_scenes", num_scenes, 1),
            ("level", level, 2),
            ("first_seed", first_seed, 0),
        ):
            if value < least:
                raise ArgumentError(f"{name}: expected at least {least}, got {value}")
        if not min_depth > 0:
            raise ArgumentError(f"min_depth: expected metres above 0, got {min_depth}")
        self.scale = min_depth / NATURAL_MIN_DEPTH
        radius = (rig.positions - rig.center).norm(dim=-1).max().item()
        if radius >= CLEAR_RADIUS * self.scale:
            raise ArgumentError(
                f"rig: its cameras lie up to {radius:.2f} m from its centre, but scenes of min_depth "
                f"{min_depth} keep only {CLEAR_RADIUS * self.scale:.2f} m free; give a min_depth above "
                f"{radius / CLEAR_RADIUS * NATURAL_MIN_DEPTH:.2f}"
            )
        self.num_scenes, self.rig, self.level, self.kind = num_scenes, rig, level, kind
        self.first_seed, self.samples_per_pixel, self.min_depth = first_seed, samples_per_pixel, min_depth
        self.antialias = antialias
        self._image_directions = Icosphere(level).vertices
        self._depth_directions = Icosphere(level - 2).vertices
        self.cache_folder = Path(cache_dir) / self._key() if cache_dir is not None else None
        if self.cache_folder is not None:
            self.cache_folder.mkdir(parents=True, exist_ok=True)

    def __len__(self) -> int:
        return self.num_scenes

    def __getitem__(self, index: int) -> dict[str, Any]:
        if not -self.num_scenes <= index < self.num_scenes:
            raise IndexError(f"index {index} is outside a data set of {self.num_scenes} scenes")
        seed = self.first_seed + index % self.num_scenes
        kind, path = self._kind(seed), self._path(seed)
        stored = _load(path) if path is not None else None
        if stored is None:
            stored = self._render(kind, seed)
            if path is not None:
                _store(path, *stored)
        images, inverse_depth = stored
        return {
            "images": _decode(images),
            "inverse_depth": inverse_depth,
            "valid": inverse_depth <= 1 / self.min_depth,
            "rig": self.rig,
            "frame": f"{kind}-{seed:08d}",
        }

    def is_cached(self, index: int) -> bool:
        """Whether the rendered sample lies in the cache; never without one."""
        path = self._path(self.first_seed + index)
        return path is not None and path.is_file()

    def _kind(self, seed: int) -> str:
        return KINDS[seed % 2] if self.kind == "mixed" else self.kind

    def _path(self, seed: int) -> Path | None:
        if self.cache_folder is None:
            return None
        return self.cache_folder / f"{self._kind(seed)}-{seed:08d}.npz"

    def _render(self, kind: str, seed: int) -> tuple[Tensor, Tensor]:
        """Images as bytes, and inverse depth."""
        center = self.rig.center
        scene = make_scene(kind, seed, center=center, scale=self.scale, clear_radius=CLEAR_RADIUS)
        pictures = render_rig(scene, self.rig, self.samples_per_pixel)
        values, seen = self.rig.sample_sphere(pictures, self._image_directions, antialias=self.antialias)
        return _encode(values * 2 - 1, seen), ray_depth(scene, center, self._depth_directions).reciprocal()

    def _key(self) -> str:
        """Folder name that stands for everything a sample depends on, the rig by its parameters and masks."""
        numbers = (GENERATION, self.level, self.samples_per_pixel, self.min_depth, self.antialias)
        digest = sha256(repr(numbers).encode())
        digest.update(_rounded(self.rig.world_from_camera))
        for name, camera in self.rig.cameras.items():
            options = [getattr(camera, option) for option in camera.option_names]
            digest.update(repr((camera.model, camera.image_size, options)).encode())
            for parameter in (*camera.intrinsic_names, "max_angle"):
                value = getattr(camera, parameter)
                digest.update(b"" if value is None else _rounded(value))
            if name in self.rig.masks:
                digest.update(self.rig.masks[name].cpu().numpy().tobytes())
        return f"level{self.level}-{digest.hexdigest()[:16]}"


def _rounded(values: Tensor) -> bytes:
    """Numbers as text of five digits: float32 and float64, and other ways to compute them, give the same."""
    flat = values.detach().cpu().double().flatten()
    return " ".join(f"{value:.5g}" for value in torch.where(flat.abs() < 1e-6, 0.0, flat).tolist()).encode()


def _encode(images: Tensor, seen: Tensor) -> Tensor:
    """[-1, 1] as bytes 1..255; byte 0 stands for "not seen"."""
    return torch.where(seen[:, None], (images * 127 + 128).round().clamp(1, 255), 0).to(torch.uint8)


def _decode(images: Tensor) -> Tensor:
    return torch.where(images > 0, (images.float() - 128) / 127, 0.0)


def _load(path: Path) -> tuple[Tensor, Tensor] | None:
    """A stored sample; None if there is none, or if it was damaged and has to be made anew."""
    try:
        with np.load(path) as stored:
            return torch.from_numpy(stored["images"]), torch.from_numpy(stored["inverse_depth"])
    except (FileNotFoundError, EOFError, KeyError, ValueError, zipfile.BadZipFile):
        return None


def _store(path: Path, images: Tensor, inverse_depth: Tensor) -> None:
    """Write under a name of our own first, so that nobody ever reads half a file."""
    temporary = path.with_name(f".{path.stem}-{uuid.uuid4().hex}.npz")
    try:
        np.savez_compressed(temporary, images=images.numpy(), inverse_depth=inverse_depth.numpy())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
