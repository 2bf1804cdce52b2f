# SPDX-License-Identifier: Apache-2.0
"""Samples of a world on the icosphere; and those of which each is seen by a rig of its own, through its own faults."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from torch import Tensor
from torch.utils.data import Dataset

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError
from sphericalvision.icosphere import Icosphere
from sphericalvision.icosphere.topology import check_level
from sphericalvision.scenes.cache import ArrayCache, decode, encode
from sphericalvision.scenes.draws import by_purpose
from sphericalvision.scenes.random_rigs import LevelOrRandomRigs
from sphericalvision.scenes.world import GENERATION, HELD_OUT_SEED, World, WorldFrame, world_values
from sphericalvision.sphere.intake import Intake

__all__ = ["RandomRigScenes", "WorldSamples"]


class WorldSamples(Dataset[dict[str, Any]]):
    """What consecutive seeds stand for in a world, on the icosphere and with the true depth.

    Args:
        world: of which samples are made.
        num_scenes: number of samples.
        first_seed: of sample 0; below 10,000,000, which are for comparing methods.
        level: of the icosphere that carries the images.
        depth_level: of the icosphere that carries depth; that of the images when not given.
        antialias: average images over the area between vertices, for images much finer than the icosphere.
        cache: where samples are kept, images as bytes; made each time when not given.

    Returns:
        Samples with ``images`` ``(n, 3, V)`` in [-1, 1], ``seen`` ``(n, V)``, ``inverse_depth`` and ``valid``
        ``(V_depth,)``, the ``rig`` as its calibration has it, and ``frame``.

    Raises:
        ArgumentError: fewer than one scene, or a seed out of range.
    """

    def __init__(
        self,
        world: World,
        num_scenes: int,
        first_seed: int,
        level: int,
        depth_level: int | None = None,
        antialias: bool = False,
        cache: ArrayCache | None = None,
    ) -> None:
        if num_scenes < 1 or first_seed < 0 or first_seed + num_scenes > HELD_OUT_SEED:
            raise ArgumentError(
                f"num_scenes, first_seed: expected 1 or more seeds from 0 to {HELD_OUT_SEED - 1}, got "
                f"{num_scenes} from {first_seed}; seeds from {HELD_OUT_SEED} are held out for the benchmark"
            )
        self.world, self.num_scenes, self.first_seed = world, num_scenes, first_seed
        self.grid, self.antialias, self.cache = Icosphere(level), antialias, cache
        self.directions = Icosphere(level if depth_level is None else check_level(depth_level)).vertices

    def __len__(self) -> int:
        return self.num_scenes

    def __getitem__(self, index: int) -> dict[str, Any]:
        if not -self.num_scenes <= index < self.num_scenes:
            raise IndexError(f"index {index} is outside a data set of {self.num_scenes} scenes")
        frame = self.world.frame(self.first_seed + index % self.num_scenes)
        if self.cache is None:
            sample = self._made(frame)
        else:
            sample = self.cache.get(frame.name, lambda: self._as_bytes(frame))
            sample["images"] = decode(sample["images"], sample["seen"])
        valid = sample["inverse_depth"] <= 1 / self.world.min_depth
        return {**sample, "valid": valid, "rig": frame.posed_rig, "frame": frame.name}

    def _made(self, frame: WorldFrame) -> dict[str, Tensor]:
        inverse_depth = frame.inverse_depth(self.directions)
        images, intake = frame.images, Intake(frame.rig, self.grid, self.antialias)
        return {"images": intake(images), "seen": intake.seen, "inverse_depth": inverse_depth}

    def _as_bytes(self, frame: WorldFrame) -> dict[str, Tensor]:
        made = self._made(frame)
        return {**made, "images": encode(made["images"])}


class RandomRigScenes(WorldSamples):
    """Samples for a network that is to serve any rig: scene, rig and disturbances follow from the seed.

    Some rigs are level rings of four fisheyes, the common case; the others are ``random_rig``. Some samples are
    disturbed as by cheap cameras (``CameraDisturbance``), with poses a little off, and some are too bright. Some rigs
    stand on something that they see, which is mostly not masked. Most scenes are under a sky that is not theirs, black,
    white, of any colour or cloudy, and a few have no lamps: so meshes and photographs of other people look. How often,
    and how much, ``conf/world/random_rigs.yaml`` says.

    Args:
        num_scenes: number of samples.
        first_seed: of sample 0; below 10,000,000, which are for comparing methods.
        level: of the icosphere that carries the images; images that are finer are averaged first, as in use.
        depth_level: of the icosphere that carries depth; that of the images when not given.
        image_size: (height, width) of the cameras.
        samples_per_pixel: rays through each pixel.
        prepare: makes of a rig and its photographs, camera name -> ``(3, h, w)`` in [0, 1], those that are used, as the
            network will have them in use (``Predictor`` takes out noise and differences in light).
        cache_dir: folder where samples are kept, images as bytes; rendered each time when not given.
        values: arguments of ``World``, and ``level_rigs``; ``world_values("random_rigs")`` when not given.

    Returns:
        Samples of ``WorldSamples``. The number of cameras differs, so batches are of one.

    Raises:
        ArgumentError: unknown kinds or shares that do not fit, fewer than one scene, or a seed out of range.

    References:
        WMGStereo (2025), "What makes good synthetic training data for zero-shot stereo matching?", for diversity
        before realism.

    Examples:
        >>> sample = RandomRigScenes(1, level=3, image_size=(24, 24))[0]
        >>> sample["images"].shape[1:], sample["inverse_depth"].shape, sample["frame"]
        (torch.Size([3, 642]), torch.Size([642]), 'corridor-00000000')
    """

    def __init__(
        self,
        num_scenes: int,
        first_seed: int = 0,
        level: int = 6,
        depth_level: int | None = None,
        image_size: tuple[int, int] = (256, 256),
        samples_per_pixel: int = 1,
        prepare: Callable[[CameraRig, Mapping[str, Tensor]], Mapping[str, Tensor]] | None = None,
        cache_dir: str | os.PathLike[str] | None = None,
        values: Mapping[str, Any] | None = None,
    ) -> None:
        chosen = dict(world_values("random_rigs") if values is None else values)
        rigs = LevelOrRandomRigs(chosen.pop("level_rigs"), (int(image_size[0]), int(image_size[1])))
        world = World.of(
            chosen, rig=rigs, draws=by_purpose, prepare=prepare, samples_per_pixel=samples_per_pixel
        )
        prepared = prepare and f"{prepare.__module__}.{prepare.__qualname__}"
        numbers = (GENERATION, level, depth_level, samples_per_pixel, "averaged")
        digest = hashlib.sha256(repr((numbers, rigs, chosen, prepared)).encode()).hexdigest()[:8]
        #: Stands for everything that a seed's sample depends on; the folder's name in the cache.
        self.name = f"random_rigs-{GENERATION}-{level}-{digest}"
        cache = ArrayCache(None if cache_dir is None else Path(cache_dir) / self.name)
        super().__init__(world, num_scenes, first_seed, level, depth_level, antialias=True, cache=cache)
