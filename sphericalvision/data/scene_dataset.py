# SPDX-License-Identifier: Apache-2.0
"""Rendered scenes as training samples on the icosphere, made on the fly and kept in a cache if wanted."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError
from sphericalvision.data.augmentation.transforms import ToSphere
from sphericalvision.data.scene_cache import SceneCache, decode, encode, parameter_digest
from sphericalvision.data.scenes.recipes import ray_depth, render_rig
from sphericalvision.data.seeded_scenes import GENERATION, NATURAL_MIN_DEPTH, SeededScenes
from sphericalvision.icosphere import Icosphere

__all__ = ["SceneDataset"]


class SceneDataset(SeededScenes):
    """Scenes of consecutive seeds, seen by a rig and brought onto the icosphere.

    Sample ``i`` is the scene of seed ``first_seed + i``, so data sets with disjoint seeds are disjoint.
    Its entries: ``images`` ``(n, 3, V_level)`` in [-1, 1], 0 where not seen; ``seen`` ``(n, V_level)``, in the field of
    view and in the mask; ``inverse_depth``
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
        >>> import torch
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
        super().__init__(num_scenes, rig, kind, first_seed, samples_per_pixel, min_depth)
        if level < 2:
            raise ArgumentError(f"level: expected at least 2, got {level}")
        self.level, self.antialias = level, antialias
        self._image_directions = Icosphere(level).vertices
        self._depth_directions = Icosphere(level - 2).vertices
        self._seen = ToSphere(level).seen(rig)
        self.cache_folder = Path(cache_dir) / self._key() if cache_dir is not None else None
        self._cache = SceneCache(self.cache_folder)

    def is_cached(self, index: int) -> bool:
        """Whether the rendered sample lies in the cache; never without one."""
        return self._cache.has(self._frame(self.first_seed + index))

    def _sample(self, seed: int) -> dict[str, Any]:
        stored = self._cache.get(self._frame(seed), lambda: self._render(seed))
        return {
            "images": decode(stored["images"], self._seen),
            "seen": self._seen,
            "inverse_depth": stored["inverse_depth"],
            "valid": stored["inverse_depth"] <= 1 / self.min_depth,
            "rig": self.rig,
            "frame": self._frame(seed),
        }

    def _render(self, seed: int) -> dict[str, Tensor]:
        """Images as bytes, and inverse depth."""
        scene = self._scene(seed)
        pictures = render_rig(scene, self.rig, self.samples_per_pixel)
        values, _ = self.rig.sample_sphere(pictures, self._image_directions, antialias=self.antialias)
        inverse_depth = ray_depth(scene, self.rig.center, self._depth_directions).reciprocal()
        return {"images": encode(values * 2 - 1), "inverse_depth": inverse_depth}

    def _key(self) -> str:
        """Folder name that stands for everything a sample depends on."""
        numbers = (GENERATION, self.level, self.samples_per_pixel, self.min_depth, self.antialias)
        return f"level{self.level}-{parameter_digest(numbers, self.rig)}"
