# SPDX-License-Identifier: Apache-2.0
"""Rendered scenes, whose depth is known, through one rig and through faults that are drawn for each sample."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch.utils.data import Dataset

from sphericalvision.cameras import CameraRig
from sphericalvision.capture.preparation.preparation import AS_IT_IS, Preparation
from sphericalvision.core import ArgumentError
from sphericalvision.data import ToSphere
from sphericalvision.icosphere import Icosphere
from sphericalvision.scenes import make_scene, ray_depth, render_rig
from sphericalvision.scenes.carriers import CARRIERS, with_carrier
from sphericalvision.scenes.disturbances import CameraDisturbance
from sphericalvision.scenes.world import HELD_OUT_SEED, NATURAL_MIN_DEPTH, world_values

__all__ = ["Rehearsal", "random_disturbance"]

Sample = dict[str, Any]

CARRIED = 0.5
"""Share of scenes with a carrier in view, where the rig has no masks that would hide one."""


def random_disturbance(grey: float) -> CameraDisturbance:
    """Faults of cameras and poses, each of which comes now and then, drawn from torch's global generator.

    Args:
        grey: how often all cameras take pictures without colour.

    Examples:
        >>> random_disturbance(grey=1.0).grey
        True
    """

    def sometimes(share: float, most: float) -> float:
        return most * torch.rand(()).item() if torch.rand(()).item() < share else 0.0

    return CameraDisturbance(
        grey=torch.rand(()).item() < grey,
        vignetting=sometimes(0.7, 0.8),
        blur=sometimes(0.3, 1.0),
        exposure=sometimes(0.5, 0.5),
        white_balance=sometimes(0.5, 0.25),
        noise=sometimes(0.5, 0.03),
        pose_error=math.radians(sometimes(0.8, 0.4)),
    )


class Rehearsal(Dataset[Sample]):
    """Scenes of all kinds as a rig would see them, disturbed, with their true depth.

    Args:
        rig: in metres in which 0.55 is the nearest hypothesis, its images not larger than needed.
        level: of the icosphere that carries the images.
        depth_level: of the icosphere that carries depth.
        grey: share of samples without colour.
        num_scenes: number of samples; what one shows is drawn, its disturbances from torch's global generator.
        first_seed: of scene 0.
        preparation: of the disturbed images, as they are made ready in use.

    Raises:
        ArgumentError: a seed is held out for the benchmark.
    """

    def __init__(
        self,
        rig: CameraRig,
        level: int,
        depth_level: int,
        grey: float,
        num_scenes: int,
        first_seed: int = 5_000_000,
        preparation: Preparation = AS_IT_IS,
    ) -> None:
        if first_seed + num_scenes > HELD_OUT_SEED:
            raise ArgumentError(
                f"first_seed: seeds from {HELD_OUT_SEED} are held out for the benchmark, and {num_scenes} scenes end "
                f"at {first_seed + num_scenes - 1}; take {HELD_OUT_SEED - num_scenes} or less"
            )
        self.rig, self.grey, self.num_scenes, self.first_seed = rig, grey, num_scenes, first_seed
        self.preparation = preparation
        self.to_sphere = ToSphere(level, depth_level, antialias=True)
        self.directions = Icosphere(depth_level).vertices

    def __len__(self) -> int:
        return self.num_scenes

    def __getitem__(self, index: int) -> Sample:
        seed = self.first_seed + index
        generator = torch.Generator().manual_seed(seed)
        all_shares = world_values("random_rigs")["kind"]
        kinds, shares = list(all_shares), torch.tensor(list(all_shares.values()))
        kind = kinds[int(torch.multinomial(shares, 1, generator=generator))]
        scene = make_scene(kind, seed, center=self.rig.center)
        inverse_depth = ray_depth(scene, self.rig.center, self.directions).reciprocal()
        if not self.rig.masks and torch.rand((), generator=generator).item() < CARRIED:
            carrier = CARRIERS[int(torch.randint(len(CARRIERS), (), generator=generator))]
            scene = with_carrier(scene, carrier, self.rig, seed).scene
        frame: Sample = {"images": render_rig(scene, self.rig, 1), "rig": self.rig}
        frame = random_disturbance(self.grey)(frame)
        rig = frame["rig"]
        return {
            "images": self.to_sphere.images(self.preparation.images(rig, frame["images"]), rig),
            "seen": self.to_sphere.seen(rig),
            "rig": rig,
            "inverse_depth": inverse_depth,
            "valid": inverse_depth <= 1 / NATURAL_MIN_DEPTH,
            "frame": f"{kind}-{seed:08d}",
        }
