# SPDX-License-Identifier: Apache-2.0
"""Rendered scenes as the cameras see them, on the icosphere and with depth panoramas, all from one small cache."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.data.augmentation.transforms import ToSphere
from sphericalvision.data.omnistereo.ground_truth import check_panorama_size
from sphericalvision.data.scene_cache import SceneCache, decode, encode, parameter_digest, rounded
from sphericalvision.data.scenes.recipes import ray_depth, render_rig
from sphericalvision.data.scenes.scene import Scene
from sphericalvision.data.seeded_scenes import GENERATION, NATURAL_MIN_DEPTH, SeededScenes
from sphericalvision.data.seen import pixels_seen
from sphericalvision.icosphere import Icosphere
from sphericalvision.sphere import Equirectangular

__all__ = ["ENTRIES", "FisheyeSceneDataset"]

ENTRIES = ("sphere", "depth", "fisheye", "panorama")
"""What a sample may be asked to hold."""

KEYS = (
    *("images", "seen", "inverse_depth", "valid", "fisheye", "fisheye_seen"),
    *("panorama_inverse_depth", "panorama_valid"),
)
"""The tensors of a sample that holds everything, in order."""


class FisheyeSceneDataset(SeededScenes):
    """Scenes of consecutive seeds as images of the cameras, of which each network takes what it wants.

    The same scenes serve networks on the icosphere and networks on panoramas. ``entries`` says what a sample
    holds, and nothing else is computed:

    * ``"sphere"``: ``images`` ``(n, 3, V_level)`` in [-1, 1], 0 where not ``seen`` ``(n, V_level)``, and ``"depth"``;
    * ``"depth"``: ``inverse_depth`` ``(V_{level-2},)`` in 1/m, exact along the rays from the rig's centre, 0 at
      infinity, and ``valid`` ``(V_{level-2},)``;
    * ``"fisheye"``: ``fisheye`` ``(n, 3, H, W)`` in [-1, 1], 0 where not ``fisheye_seen`` ``(n, H, W)``;
    * ``"panorama"``: ``panorama_inverse_depth`` ``(h, w)`` and ``panorama_valid`` ``(h, w)``, exact as well.

    Every sample has ``rig`` and ``frame``. Sample ``i`` is the scene of seed ``first_seed + i``: the scene that
    ``SceneDataset`` shows.

    Args:
        num_scenes: number of samples.
        rig: unbatched; for ``"fisheye"`` its images must have one size.
        level: of the icosphere that carries the images; depth is two levels below.
        panorama: (height, width) of the depth panorama: W = 2H is the full sphere, W = 4H the latitudes within
            45°.
        entries: some of "sphere", "depth", "fisheye", "panorama".
        kind: ``"room"``, ``"floating"``, or ``"mixed"`` (even seeds are rooms, odd ones floating objects).
        first_seed: seed of sample 0.
        samples_per_pixel: rays through each pixel.
        min_depth: least depth that the network tells apart, metres. Scenes scale with it: 0.55 is natural size.
        antialias: average images over the area between vertices, for images much finer than the icosphere.
        cache_dir: folder where images are kept as bytes, and depths; shared by any number of processes, and by
            data sets of any levels and panoramas. Tilted rigs share the depths.

    Raises:
        ArgumentError: an unknown entry or kind, none at all, level below 2, fewer than one scene, a seed below 0,
            images of several sizes, or cameras farther from the rig's centre than the space that scenes keep free.
        ShapeError: the panorama is neither of the two.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> scenes = FisheyeSceneDataset(1, ring_rig(2, image_size=(24, 24)), level=3, panorama=(8, 16))
        >>> {key: tuple(value.shape) for key, value in scenes[0].items() if isinstance(value, torch.Tensor)}
        ... # doctest: +NORMALIZE_WHITESPACE
        {'images': (2, 3, 642), 'seen': (2, 642), 'inverse_depth': (42,), 'valid': (42,),
         'fisheye': (2, 3, 24, 24), 'fisheye_seen': (2, 24, 24),
         'panorama_inverse_depth': (8, 16), 'panorama_valid': (8, 16)}
        >>> only = FisheyeSceneDataset(1, ring_rig(2, image_size=(24, 24)), entries=("fisheye",))
        >>> sorted(only[0])
        ['fisheye', 'fisheye_seen', 'frame', 'rig']
    """

    def __init__(
        self,
        num_scenes: int,
        rig: CameraRig,
        level: int = 5,
        panorama: Sequence[int] = (80, 160),
        entries: Iterable[str] = ("sphere", "fisheye", "panorama"),
        kind: str = "room",
        first_seed: int = 0,
        samples_per_pixel: int = 1,
        min_depth: float = NATURAL_MIN_DEPTH,
        antialias: bool = False,
        cache_dir: str | os.PathLike[str] | None = None,
    ) -> None:
        super().__init__(num_scenes, rig, kind, first_seed, samples_per_pixel, min_depth)
        self.entries = tuple(entries)
        if not self.entries:
            raise ArgumentError(f"entries: expected some of {', '.join(map(repr, ENTRIES))}, got none")
        for entry in self.entries:
            check_choice("entries", entry, ENTRIES)
        sizes = {camera.image_size for camera in rig.cameras.values()}
        if "fisheye" in self.entries and len(sizes) > 1:
            raise ArgumentError(
                f"rig: images of one size are wanted for the entry 'fisheye', got {sorted(sizes)}; bring them to "
                "one size with rig.resized(...)"
            )
        if level < 2:
            raise ArgumentError(f"level: expected at least 2, got {level}")
        self.level, self.panorama = level, (int(panorama[0]), int(panorama[1]))
        check_panorama_size(*self.panorama)
        self.to_sphere = ToSphere(level, antialias=antialias)
        if "fisheye" in self.entries:
            self._fisheye_seen = torch.stack(list(pixels_seen(rig).values()))
        root = None if cache_dir is None else Path(cache_dir)
        self._images = _cache(root, "fisheye", (samples_per_pixel, min_depth), rig)
        self._depths = {
            key: _depth_cache(root, f"depth-{name}", min_depth, rig)
            for key, name in self._depth_names().items()
        }

    def is_cached(self, index: int) -> bool:
        """Whether all that was rendered for a sample lies in the cache; never without one."""
        frame = self._frame(self.first_seed + index)
        caches = [*self._depths.values(), *([self._images] if self._wants_images else [])]
        return all(cache.has(frame) for cache in caches)

    @property
    def _wants_images(self) -> bool:
        return "sphere" in self.entries or "fisheye" in self.entries

    def _depth_names(self) -> dict[str, str]:
        """The grids whose depths are wanted: key of the sample's entry -> name for the cache."""
        names = {}
        if "sphere" in self.entries or "depth" in self.entries:
            names["inverse_depth"] = f"level{self.level - 2}"
        if "panorama" in self.entries:
            names["panorama_inverse_depth"] = "x".join(map(str, self.panorama))
        return names

    def _directions(self, key: str) -> Tensor:
        if key == "inverse_depth":
            return Icosphere(self.level - 2).vertices
        return Equirectangular.with_square_pixels(*self.panorama).directions

    def _sample(self, seed: int) -> dict[str, Any]:
        frame = self._frame(seed)
        scene = functools.cache(lambda: self._scene(seed))  # not made at all if the cache has everything
        sample: dict[str, Any] = {}
        if self._wants_images:
            images = self._images.get(frame, lambda: self._render(scene()))
            if "sphere" in self.entries:
                sample["images"] = self.to_sphere.images({n: _light(i) for n, i in images.items()}, self.rig)
                sample["seen"] = self.to_sphere.seen(self.rig)
        for key, cache in self._depths.items():
            stored = cache.get(frame, functools.partial(self._depth, scene, key))
            sample[key] = stored["inverse_depth"]
            sample[key.replace("inverse_depth", "valid")] = stored["inverse_depth"] <= 1 / self.min_depth
        if "fisheye" in self.entries:
            seen = self._fisheye_seen
            sample["fisheye"] = decode(torch.stack([images[name] for name in self.rig.names]), seen)
            sample["fisheye_seen"] = seen
        return {key: sample[key] for key in KEYS if key in sample} | {"rig": self.rig, "frame": frame}

    def _render(self, scene: Scene) -> dict[str, Tensor]:
        """Images as bytes, by camera."""
        pictures = render_rig(scene, self.rig, self.samples_per_pixel)
        return {name: encode(picture * 2 - 1) for name, picture in pictures.items()}

    def _depth(self, scene: Callable[[], Scene], key: str) -> dict[str, Tensor]:
        return {"inverse_depth": ray_depth(scene(), self.rig.center, self._directions(key)).reciprocal()}


def _cache(root: Path | None, name: str, numbers: tuple[object, ...], rig: CameraRig) -> SceneCache:
    digest = parameter_digest((GENERATION, *numbers), rig)
    return SceneCache(None if root is None else root / f"{name}-{digest}")


def _depth_cache(root: Path | None, name: str, min_depth: float, rig: CameraRig) -> SceneCache:
    """Depths depend on where the rig's centre is, and on nothing else of it."""
    where = f"min{min_depth:.5g}-at{rounded(rig.center).decode().replace(' ', '_')}"
    return SceneCache(None if root is None else root / f"{name}-{where}-{GENERATION}")


def _light(image: Tensor) -> Tensor:
    """Bytes as [0, 1], as the renderer gives them."""
    return ((image.float() - 1) / 254).clamp(min=0)
