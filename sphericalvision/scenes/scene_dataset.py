# SPDX-License-Identifier: Apache-2.0
"""Rendered scenes as samples: images of the cameras or on the icosphere, depth there or in panoramas, and one cache."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import Dataset

from sphericalvision.cameras import CameraRig
from sphericalvision.cameras.fingerprint import rig_fingerprint, rounded_text
from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.data.augmentation.transforms import ToSphere
from sphericalvision.data.omnistereo.ground_truth import check_panorama_size
from sphericalvision.icosphere import Icosphere
from sphericalvision.icosphere.topology import check_level
from sphericalvision.scenes.cache import ArrayCache, decode, encode
from sphericalvision.scenes.meshes import MeshFiles
from sphericalvision.scenes.world import GENERATION, NATURAL_MIN_DEPTH, World, WorldFrame
from sphericalvision.sphere import Equirectangular, SphereGrid
from sphericalvision.sphere.intake import pixels_seen, signed

__all__ = ["ENTRIES", "SceneDataset"]

ENTRIES = ("sphere", "depth", "fisheye", "panorama")
"""What a sample may be asked to hold."""

KEYS = (
    *("images", "seen", "inverse_depth", "valid", "fisheye", "fisheye_seen"),
    *("panorama_inverse_depth", "panorama_valid"),
)
"""The tensors of a sample that holds everything, in order."""


class SceneDataset(Dataset[dict[str, Any]]):
    """Scenes of consecutive seeds, seen by a rig, with the entries that networks need for training.

    Sample ``i`` is the scene of seed ``first_seed + i``, so data sets with disjoint seeds are disjoint. ``entries``
    selects what a sample contains; nothing else is computed:

    * ``"sphere"``: ``images`` ``(n, 3, V_level)`` in [-1, 1], 0 where not ``seen`` ``(n, V_level)`` (in the field of
      view and in the mask), and ``"depth"``;
    * ``"depth"``: ``inverse_depth`` ``(V_depth,)`` in 1/m, exact along the rays from the rig's centre, 0 at infinity,
      and ``valid`` ``(V_depth,)``;
    * ``"fisheye"``: ``fisheye`` ``(n, 3, H, W)`` in [-1, 1], 0 where not ``fisheye_seen`` ``(n, H, W)``;
    * ``"panorama"``: ``panorama_inverse_depth`` ``(h, w)`` and ``panorama_valid`` ``(h, w)``, exact as well.

    Every sample has ``rig`` and ``frame``.

    Args:
        num_scenes: number of samples.
        rig: unbatched; for ``"fisheye"`` its images must have one size.
        level: of the icosphere that carries the images.
        kind: of ``make_scene``, or a mixture of ``kind_of``: ``"mixed"`` takes rooms and floating objects by turns.
        first_seed: seed of sample 0.
        samples_per_pixel: rays through each pixel.
        min_depth: least depth that the network tells apart, metres. Scenes scale with it: 0.55 is natural size.
        antialias: average images over the area between vertices, for images much finer than the icosphere.
        cache_dir: folder where images are kept as bytes, and depths; shared by any number of processes, and by
            data sets of any parameters. Tilted rigs share the depths.
        entries: some of "sphere", "depth", "fisheye", "panorama".
        panorama: (height, width) of the depth panorama: W = 2H is the full sphere, W = 4H the latitudes within
            45°.
        stored: which images become bytes and are kept: ``"sphere"``, small and for one level, or ``"camera"``, from
            which every level and ``"fisheye"`` are made. ``"camera"`` whenever ``"fisheye"`` is asked for.
        meshes: of which scenes are made in place of a kind; see ``meshes.mesh_files``.
        carrier: what carries the rig and is in view: "pole", "robot" or "vehicle".
        depth_level: of the icosphere that carries depth; two below ``level`` when not given.
        tilts: least and largest radians by which all cameras look further down, drawn for each scene from its seed;
            each camera then looks up to 8° further up or down. The rig as it is when not given.

    Raises:
        ArgumentError: an unknown entry or kind, none at all, level below 2, fewer than one scene, a seed below 0,
            images of several sizes, or cameras farther from the rig's centre than the space that scenes keep free.
        ShapeError: the panorama is neither of the two.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> rig = ring_rig(2, image_size=(24, 24))
        >>> sample = SceneDataset(1, rig, level=3)[0]
        >>> {key: tuple(value.shape) for key, value in sample.items() if isinstance(value, torch.Tensor)}
        {'images': (2, 3, 642), 'seen': (2, 642), 'inverse_depth': (42,), 'valid': (42,)}
        >>> sorted(SceneDataset(1, rig, entries=("fisheye", "panorama"))[0])
        ['fisheye', 'fisheye_seen', 'frame', 'panorama_inverse_depth', 'panorama_valid', 'rig']
    """

    def __init__(
        self,
        num_scenes: int,
        rig: CameraRig,
        level: int = 5,
        kind: str = "room",
        first_seed: int = 0,
        samples_per_pixel: int = 1,
        min_depth: float = NATURAL_MIN_DEPTH,
        antialias: bool = False,
        cache_dir: str | os.PathLike[str] | None = None,
        entries: Iterable[str] = ("sphere",),
        panorama: Sequence[int] = (80, 160),
        stored: str = "sphere",
        meshes: MeshFiles | None = None,
        carrier: str | None = None,
        depth_level: int | None = None,
        tilts: tuple[float, float] | None = None,
    ) -> None:
        for name, value, least in (
            ("num_scenes", num_scenes, 1),
            ("first_seed", first_seed, 0),
            ("level", level, 2),
        ):
            if value < least:
                raise ArgumentError(f"{name}: expected at least {least}, got {value}")
        self.world = World(
            rig,
            kind,
            min_depth,
            meshes,
            tilts,
            carrier,
            carrier_counts=True,
            samples_per_pixel=samples_per_pixel,
        )
        self.world.check_free_space(rig)
        self.entries = _checked_entries(entries, rig)
        self.num_scenes, self.rig, self.first_seed = num_scenes, rig, first_seed
        self.min_depth, self.level = min_depth, level
        self.depth_level = level - 2 if depth_level is None else check_level(depth_level)
        self.panorama = (int(panorama[0]), int(panorama[1]))
        check_panorama_size(*self.panorama)
        check_choice("stored", stored, ("sphere", "camera"))
        self.stored = "camera" if "fisheye" in self.entries else stored
        self.to_sphere = ToSphere(level, antialias=antialias)
        root = None if cache_dir is None else Path(cache_dir)
        self._images = self._image_cache(root) if {"sphere", "fisheye"} & set(self.entries) else None
        self._depths = self._depth_caches(root)
        self._frame_seen = torch.stack(list(pixels_seen(rig).values())) if "fisheye" in self.entries else None

    def __len__(self) -> int:
        return self.num_scenes

    def __getitem__(self, index: int) -> dict[str, Any]:
        if not -self.num_scenes <= index < self.num_scenes:
            raise IndexError(f"index {index} is outside a data set of {self.num_scenes} scenes")
        frame = self.world.frame(self.first_seed + index % self.num_scenes)
        name, rig = frame.name, frame.true_rig
        sample: dict[str, Any] = {}
        if self._images is not None:
            sample |= self._shown(self._images.get(name, lambda: self._render(frame)), rig)
        for key, (grid, cache) in self._depths.items():
            measure = functools.partial(self._measure, frame, grid)
            sample[key] = cache.get(name, measure)["inverse_depth"]
            sample[key.replace("inverse_depth", "valid")] = sample[key] <= 1 / self.min_depth
        return {key: sample[key] for key in KEYS if key in sample} | {"rig": rig, "frame": name}

    def is_cached(self, index: int) -> bool:
        """Whether all that was rendered for a sample lies in the cache; never without one."""
        name = self.world.frame(self.first_seed + index).name
        return all(cache.has(name) for cache in self._caches)

    @property
    def cache_folders(self) -> list[Path]:
        """Folders that stand for everything that the samples depend on; none without a cache."""
        return [cache.folder for cache in self._caches if cache.folder is not None]

    @property
    def _caches(self) -> list[ArrayCache]:
        depths = [cache for _, cache in self._depths.values()]
        return depths if self._images is None else [self._images, *depths]

    def _shown(self, stored: dict[str, Tensor], rig: CameraRig) -> dict[str, Tensor]:
        """The images that a sample holds, of those that are stored."""
        if self.stored == "sphere":
            seen = self.to_sphere.seen(rig)
            return {"images": decode(stored["images"], seen), "seen": seen}
        shown = {}
        if "sphere" in self.entries:
            light = {name: ((image.float() - 1) / 254).clamp(min=0) for name, image in stored.items()}
            shown = {
                "images": self.to_sphere.images(light, rig),
                "seen": self.to_sphere.seen(rig),
            }
        if self._frame_seen is not None:
            frames = torch.stack([stored[name] for name in rig.names])
            shown |= {"fisheye": decode(frames, self._frame_seen), "fisheye_seen": self._frame_seen}
        return shown

    def _render(self, frame: WorldFrame) -> dict[str, Tensor]:
        """Images as bytes: by camera, or all on the icosphere."""
        if self.stored == "camera":
            return {name: encode(signed(image)) for name, image in frame.images.items()}
        directions, antialias = Icosphere(self.level).vertices, self.to_sphere.antialias
        values, _ = frame.true_rig.sample_sphere(frame.images, directions, antialias=antialias)
        return {"images": encode(signed(values))}

    def _image_cache(self, root: Path | None) -> ArrayCache:
        numbers: tuple[object, ...] = (GENERATION, self.world.samples_per_pixel, self.min_depth)
        numbers = (*numbers, *(f"{tilt:.5g}" for tilt in self.world.tilts or ()))
        holds: dict[str, Any]
        if self.stored == "camera":
            name = "fisheye"
            holds = {n: ((3, *camera.image_size), torch.uint8) for n, camera in self.rig.cameras.items()}
        else:
            name, numbers = f"level{self.level}", (*numbers, self.level, self.to_sphere.antialias)
            holds = {"images": ((len(self.rig), 3, Icosphere(self.level).num_vertices), torch.uint8)}
        return ArrayCache(_below(root, f"{name}-{rig_fingerprint(self.rig, numbers)}"), holds)

    @staticmethod
    def _measure(frame: WorldFrame, grid: Callable[[], SphereGrid]) -> dict[str, Tensor]:
        return {"inverse_depth": frame.inverse_depth(grid().directions)}

    def _depth_caches(self, root: Path | None) -> dict[str, tuple[Callable[[], SphereGrid], ArrayCache]]:
        """By the sample's entry, on which grid depth is wanted, and where it is kept."""
        found: dict[str, tuple[Callable[[], SphereGrid], ArrayCache]] = {}
        if {"sphere", "depth"} & set(self.entries):
            level, shape = self.depth_level, (Icosphere(self.depth_level).num_vertices,)
            cache = self._depth_cache(root, f"level{level}", shape)
            found["inverse_depth"] = functools.partial(Icosphere, level), cache
        if "panorama" in self.entries:
            size = self.panorama
            cache = self._depth_cache(root, "x".join(map(str, size)), size)
            found["panorama_inverse_depth"] = (
                functools.partial(Equirectangular.with_square_pixels, *size),
                cache,
            )
        return found

    def _depth_cache(self, root: Path | None, grid: str, shape: tuple[int, ...]) -> ArrayCache:
        """Depths depend on where the rig's centre is, and on nothing else of it but for the size of its carrier."""
        center = rounded_text(self.rig.center).decode().replace(" ", "_")
        name = f"depth-{grid}-min{self.min_depth:.5g}-at{center}-{GENERATION}"
        if self.world.carrier is not None:
            name += f"-{rig_fingerprint(self.rig)}"
        return ArrayCache(_below(root, name), {"inverse_depth": (shape, torch.float32)})


def _checked_entries(entries: Iterable[str], rig: CameraRig) -> tuple[str, ...]:
    chosen = tuple(entries)
    if not chosen:
        raise ArgumentError(f"entries: expected some of {', '.join(map(repr, ENTRIES))}, got none")
    for entry in chosen:
        check_choice("entries", entry, ENTRIES)
    sizes = {camera.image_size for camera in rig.cameras.values()}
    if "fisheye" in chosen and len(sizes) > 1:
        raise ArgumentError(
            f"rig: images of one size are wanted for the entry 'fisheye', got {sorted(sizes)}; bring them to "
            "one size with rig.resized(...)"
        )
    return chosen


def _below(root: Path | None, name: str) -> Path | None:
    return None if root is None else root / name
