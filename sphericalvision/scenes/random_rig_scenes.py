# SPDX-License-Identifier: Apache-2.0
"""Rendered scenes of all kinds, each seen by a rig of its own and through faults of its own."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import Dataset

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.core import ArgumentError
from sphericalvision.data.augmentation.transforms import ToSphere
from sphericalvision.icosphere import Icosphere
from sphericalvision.icosphere.topology import check_level
from sphericalvision.scenes.cache import ArrayCache, decode, encode
from sphericalvision.scenes.carriers import CARRIERS, carrier_masks, with_carrier
from sphericalvision.scenes.disturbances import DISPLAY, CameraDisturbance
from sphericalvision.scenes.random_rigs import random_rig
from sphericalvision.scenes.recipes import SCENE_KINDS, exposed, make_scene, ray_depth, render_rig
from sphericalvision.scenes.rendering.scene import Scene
from sphericalvision.scenes.seeded_scenes import GENERATION, HELD_OUT_SEED, NATURAL_MIN_DEPTH
from sphericalvision.scenes.skies import under_another_sky, unlit

__all__ = ["SHARES", "RandomRigScenes"]

#: How often each kind of scene comes.
SHARES = {
    "room": 0.16,
    "floating": 0.18,
    "patchwork": 0.14,
    "rough": 0.1,
    "glazed": 0.1,
    "outdoors": 0.08,
    "hall": 0.06,
    "corridor": 0.06,
    "bare": 0.06,
    "polished": 0.06,
}

CARRIED, MASKED = 0.35, 0.35
"""Share of rigs that see what carries them, and share of these whose masks say so."""
TOO_BRIGHT, LEAST_STOPS, MOST_STOPS = 0.3, 0.3, 2.5
"""Share of samples that are too bright in all cameras, and by how much: bright walls have no texture then."""
OTHER_SKY, UNLIT = 0.6, 0.12
"""Share of scenes under a sky of any other colour, or with clouds; and share of those without lamps."""


class RandomRigScenes(Dataset[dict[str, Any]]):
    """Samples for a network that is to serve any rig: scene, rig and disturbances follow from the seed.

    Two fifths of the rigs are level rings of four fisheyes, the common case; the others are ``random_rig``. Half of the
    samples are disturbed as by cheap cameras (``CameraDisturbance``), with poses off by up to 0.4°. Three tenths are
    too bright, by up to 2.5 stops. A third of the rigs stand on something that they see, which is mostly not masked.
    Three fifths of the scenes are under a sky that is not theirs, black, white, of any colour or cloudy, and one in
    eight has no lamps: so meshes and photographs of other people look.

    Args:
        num_scenes: number of samples.
        first_seed: of sample 0; below 10,000,000, which are for comparing methods.
        level: of the icosphere that carries the images.
        depth_level: of the icosphere that carries depth; that of the images when not given.
        shares: how often each kind of scene comes, by its name; ``SHARES`` when not given.
        level_rigs: share of level rings.
        disturbed: share of samples that are disturbed.
        image_size: (height, width) of the cameras.
        samples_per_pixel: rays through each pixel.
        prepare: makes of a rig and its photographs, camera name -> ``(3, h, w)`` in [0, 1], those that are used, as the
            network will have them in use (``deploy.Predictor`` takes out noise and differences in light).
        cache_dir: folder where samples are kept, images as bytes; rendered each time when not given.

    Returns:
        Samples with ``images`` ``(n, 3, V)``, ``seen`` ``(n, V)``, ``inverse_depth`` and ``valid`` ``(V_depth,)``, the
        ``rig`` as its calibration has it, and ``frame``. n differs, so batches are of one.

    Raises:
        ArgumentError: unknown kinds or shares that do not fit, fewer than one scene, or a seed out of range.

    References:
        WMGStereo (2025), "What makes good synthetic training data for zero-shot stereo matching?", for diversity
        before realism.

    Examples:
        >>> sample = RandomRigScenes(1, level=3, image_size=(24, 24))[0]
        >>> sample["images"].shape[1:], sample["inverse_depth"].shape, sample["frame"]
        (torch.Size([3, 642]), torch.Size([642]), 'rough-00000000')
    """

    def __init__(
        self,
        num_scenes: int,
        first_seed: int = 0,
        level: int = 6,
        depth_level: int | None = None,
        shares: Mapping[str, float] | None = None,
        level_rigs: float = 0.4,
        disturbed: float = 0.5,
        image_size: tuple[int, int] = (256, 256),
        samples_per_pixel: int = 1,
        prepare: Callable[[CameraRig, Mapping[str, Tensor]], Mapping[str, Tensor]] | None = None,
        cache_dir: str | os.PathLike[str] | None = None,
    ) -> None:
        if num_scenes < 1 or first_seed < 0 or first_seed + num_scenes > HELD_OUT_SEED:
            raise ArgumentError(
                f"num_scenes, first_seed: expected 1 or more seeds from 0 to {HELD_OUT_SEED - 1}, got "
                f"{num_scenes} from {first_seed}"
            )
        self.shares = dict(SHARES if shares is None else shares)
        if set(self.shares) - set(SCENE_KINDS) or not sum(self.shares.values()) > 0:
            raise ArgumentError(f"shares: expected some of {', '.join(SCENE_KINDS)}, got {self.shares}")
        self.num_scenes, self.first_seed = num_scenes, first_seed
        self.level = check_level(level)
        self.depth_level = self.level if depth_level is None else check_level(depth_level)
        self.level_rigs, self.disturbed = level_rigs, disturbed
        self.image_size, self.samples_per_pixel = (int(image_size[0]), int(image_size[1])), samples_per_pixel
        self.prepare = prepare
        self.directions = Icosphere(self.depth_level).vertices
        numbers = (GENERATION, self.level, self.depth_level, *self.image_size, samples_per_pixel)
        choices = (level_rigs, disturbed, *(f"{kind}{share:g}" for kind, share in self.shares.items()))
        prepared = prepare and f"{prepare.__module__}.{prepare.__name__}"
        choices = (*choices, CARRIED, MASKED, TOO_BRIGHT, LEAST_STOPS, MOST_STOPS, OTHER_SKY, UNLIT, prepared)
        #: Stands for everything that a seed's sample depends on; the folder's name in the cache.
        self.name = f"random_rigs-{'-'.join(map(str, numbers))}-{_digest(choices)}"
        self.cache = ArrayCache(None if cache_dir is None else Path(cache_dir) / self.name)

    def __len__(self) -> int:
        return self.num_scenes

    def __getitem__(self, index: int) -> dict[str, Any]:
        if not -self.num_scenes <= index < self.num_scenes:
            raise IndexError(f"index {index} is outside a data set of {self.num_scenes} scenes")
        seed = self.first_seed + index % self.num_scenes
        frame = self.frame(seed)
        stored = self.cache.get(frame, lambda: self._stored(seed))
        seen = stored["seen"]
        sample = {"images": decode(stored["images"], seen), "seen": seen}
        inverse_depth = stored["inverse_depth"]
        valid = inverse_depth <= 1 / NATURAL_MIN_DEPTH
        return sample | {
            "inverse_depth": inverse_depth,
            "valid": valid,
            "rig": self.rig(seed),
            "frame": frame,
        }

    def frame(self, seed: int) -> str:
        """Kind and seed of a sample's scene."""
        kinds, shares = list(self.shares), torch.tensor(list(self.shares.values()))
        drawn = torch.rand((), generator=_generator(seed, 0))
        number = int((shares.cumsum(0) / shares.sum() <= drawn).sum().clamp(max=len(kinds) - 1))
        return f"{kinds[number]}-{seed:08d}"

    def true_rig(self, seed: int) -> CameraRig:
        """The rig that takes the pictures of a seed."""
        generator = _generator(seed, 1)
        if torch.rand((), generator=generator) < self.level_rigs:
            return ring_rig(4, 0.2, self.image_size, math.radians(220))
        return random_rig(generator, image_size=self.image_size)

    def rig(self, seed: int) -> CameraRig:
        """The rig of a seed as its calibration has it, poses a little wrong now and then; without masks."""
        rig = self.true_rig(seed)
        images = {name: torch.zeros(3, 1, 1) for name in rig.names}
        only_poses = CameraDisturbance(pose_error=self.disturbance(seed).pose_error)
        turned: CameraRig = only_poses({"images": images, "rig": rig}, _generator(seed, 4))["rig"]
        return turned

    def gain(self, seed: int) -> float:
        """Factor on the values of all pictures of a seed, which makes some samples too bright."""
        happens, amount = torch.rand(2, generator=_generator(seed, 5)).tolist()
        stops = LEAST_STOPS + (MOST_STOPS - LEAST_STOPS) * amount if happens < TOO_BRIGHT else 0.0
        return float(2 ** (stops / DISPLAY))

    def scene(self, seed: int) -> Scene:
        """The scene of a seed, now and then without lamps, mostly under another sky."""
        scene = make_scene(self.frame(seed).rpartition("-")[0], seed)
        generator = _generator(seed, 6)
        dull, skies = torch.rand(2, generator=generator).tolist()
        if dull < UNLIT:
            scene = exposed(unlit(scene), 0.45)
        return under_another_sky(scene, generator) if skies < OTHER_SKY else scene

    def disturbance(self, seed: int) -> CameraDisturbance:
        """What is wrong with the cameras of a seed."""
        generator = _generator(seed, 2)

        def uniform() -> float:
            return torch.rand((), generator=generator).item()

        def sometimes(share: float, most: float) -> float:
            return most * uniform() if uniform() < share else 0.0

        if uniform() >= self.disturbed:
            return CameraDisturbance()
        return CameraDisturbance(
            grey=uniform() < 0.2,
            vignetting=sometimes(0.5, 0.6),
            blur=sometimes(0.4, 1.0),
            exposure=sometimes(0.7, 0.7),
            white_balance=sometimes(0.5, 0.25),
            noise=sometimes(0.75, 0.035),
            pose_error=math.radians(sometimes(0.6, 0.4)),
        )

    def _stored(self, seed: int) -> dict[str, Tensor]:
        rig, told, scene = self.true_rig(seed), self.rig(seed), self.scene(seed)
        depth = ray_depth(scene, rig.center, self.directions)
        masks: dict[str, Tensor] = {}
        generator = _generator(seed, 3)
        if torch.rand((), generator=generator) < CARRIED:
            carrier = CARRIERS[int(torch.randint(len(CARRIERS), (), generator=generator))]
            carried = with_carrier(scene, carrier, rig, seed)
            scene = carried.scene
            if torch.rand((), generator=generator) < MASKED:
                masks = carrier_masks(carried.body, rig)
        pictures: Mapping[str, Tensor] = render_rig(scene, rig, self.samples_per_pixel)
        gain = self.gain(seed)
        faults = self.disturbance(seed)
        pictures = {
            name: faults.image((gain * picture).clamp(max=1), rig.cameras[name], generator)
            for name, picture in pictures.items()
        }
        told = CameraRig(told.cameras, told.world_from_camera, masks=masks)
        if self.prepare is not None:
            pictures = self.prepare(told, pictures)
        to_sphere = ToSphere(self.level, self.depth_level)
        seen = to_sphere.seen(told)
        images = encode(to_sphere.images(pictures, told))
        return {"images": images, "seen": seen, "inverse_depth": depth.reciprocal()}


def _digest(values: tuple[object, ...]) -> str:
    return hashlib.sha256(repr(values).encode()).hexdigest()[:8]


def _generator(seed: int, purpose: int) -> torch.Generator:
    """Randomness of its own for each purpose, so that one more draw for one changes nothing of another."""
    return torch.Generator().manual_seed(seed * 8 + purpose)
