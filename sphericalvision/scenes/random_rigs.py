# SPDX-License-Identifier: Apache-2.0
"""Rigs drawn at random: how many cameras, where, how they look, through which lenses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from sphericalvision.cameras import Camera, CameraRig, EquirectangularCamera, FisheyeCamera, ring_rig
from sphericalvision.core import ArgumentError
from sphericalvision.geometry import transform_from_axis_angle

TILT_SPREAD = math.radians(8)
"""By which a camera may look further up or down than the others."""


def random_rig(
    generator: torch.Generator | None = None,
    num_cameras: Sequence[int] = (2, 3, 4, 5, 6),
    radius: tuple[float, float] = (0.08, 0.33),
    image_size: tuple[int, int] = (256, 256),
    panoramas: float = 0.2,
) -> CameraRig:
    """Return a rig that people might build: cameras around a centre that look outwards, more or less.

    All cameras have one model. They stand evenly on a ring, up to a fifth of their spacing and 6 cm in height out of
    place, are tilted together by −15° to 45° and each by up to 8° more or less. Lenses are equidistant, 180° to 240°.
    The mean of the positions is the origin.

    Args:
        generator: source of randomness; torch's global one when not given.
        num_cameras: numbers to choose from.
        radius: least and largest radius of the ring in metres; its logarithm is uniform.
        image_size: (height, width) of fisheyes; panoramas have as many pixels in a degree at the horizon.
        panoramas: probability with which the cameras are 360° cameras.

    Raises:
        ArgumentError: fewer than two cameras, or a radius that is not positive.

    Examples:
        >>> rig = random_rig(torch.Generator().manual_seed(3))
        >>> bool(rig.center.norm() < 1e-6), 2 <= len(rig) <= 6
        (True, True)
    """
    if not num_cameras or min(num_cameras) < 2 or not 0 < radius[0] <= radius[1]:
        raise ArgumentError(
            f"random_rig: expected two or more cameras and radii above 0, got {tuple(num_cameras)} and {radius}"
        )

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * torch.rand((), generator=generator).item()

    shared = _ring_of_cameras(generator, num_cameras, radius, panoramas)
    count, ring, yaw, tilt, field_of_view, panoramic = shared
    camera: Camera
    if panoramic:
        height = round(image_size[0] * math.pi / math.radians(220) / 2) * 2
        camera = EquirectangularCamera((height, 2 * height))
    else:
        camera = FisheyeCamera.from_field_of_view(image_size, field_of_view)
    poses = []
    for number in range(count):
        around = yaw + (number + uniform(-0.2, 0.2)) * 2 * math.pi / count
        position = torch.tensor([ring * math.sin(around), uniform(-0.06, 0.06), ring * math.cos(around)])
        look = transform_from_axis_angle(torch.tensor([0.0, around, 0.0]), position)
        down = tilt + math.radians(uniform(-8, 8))
        roll = math.radians(uniform(-8, 8))
        tilted = transform_from_axis_angle(torch.tensor([-down, 0.0, 0.0]), torch.zeros(3))
        rolled = transform_from_axis_angle(torch.tensor([0.0, 0.0, roll]), torch.zeros(3))
        poses.append(look @ tilted @ rolled)
    world_from_camera = torch.stack(poses)
    world_from_camera[:, :3, 3] -= world_from_camera[:, :3, 3].mean(0)
    return CameraRig([camera] * count, world_from_camera)


def _ring_of_cameras(
    generator: torch.Generator | None,
    num_cameras: Sequence[int] = (2, 3, 4, 5, 6),
    radius: tuple[float, float] = (0.08, 0.33),
    panoramas: float = 0.2,
) -> tuple[int, float, float, float, float, bool]:
    """What all cameras of a random rig share: how many, radius, yaw, tilt, field of view, and if they are panoramas."""
    number, far, yaw, tilt, view, kind = torch.rand(6, generator=generator).tolist()
    least, most = map(math.log, radius)
    return (
        int(num_cameras[int(len(num_cameras) * number)]),
        math.exp(least + (most - least) * far),
        2 * math.pi * yaw,
        math.radians(-15 + 60 * tilt),
        math.radians(180 + 60 * view),
        kind < panoramas,
    )


@dataclass(frozen=True)
class LevelOrRandomRigs:
    """Rigs drawn one by one: level rings of four fisheyes of 220°, the common case, or ``random_rig``.

    Args:
        level: share of level rings.
        image_size: (height, width) of the cameras.
        num_cameras: of ``random_rig``, numbers to choose from.
    """

    level: float
    image_size: tuple[int, int]
    num_cameras: tuple[int, ...] = (2, 3, 4, 5, 6)

    def kind(self, generator: torch.Generator) -> tuple[int, bool]:
        """The number of cameras of the rig that a generator stands for, and whether they are panoramas.

        Rigs of one kind can be put into a batch. To draw the kind costs a hundredth of what the rig costs.
        """
        if torch.rand((), generator=generator) < self.level:
            return 4, False
        count, *_, panoramic = _ring_of_cameras(generator, self.num_cameras)
        return count, panoramic

    def __call__(self, generator: torch.Generator) -> CameraRig:
        if torch.rand((), generator=generator) < self.level:
            return ring_rig(4, 0.2, self.image_size, math.radians(220))
        return random_rig(generator, self.num_cameras, image_size=self.image_size)
