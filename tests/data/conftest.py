# SPDX-License-Identifier: Apache-2.0
"""A small rig like that of the published sets, and frames of noise for it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch

from sphericalvision.cameras import CameraRig, FisheyeCamera
from sphericalvision.geometry import transform_from_axis_angle

Sample = dict[str, Any]


def _rig(radius: float = 0.2, num_cameras: int = 4, image_size: tuple[int, int] = (50, 48)) -> CameraRig:
    """Cameras of 220 degrees that look outwards from a circle, the first one forward."""
    camera = FisheyeCamera.from_field_of_view(image_size, math.radians(220))
    turns = torch.arange(num_cameras, dtype=torch.float64) * (2 * math.pi / num_cameras)
    axis = torch.stack((torch.zeros_like(turns), turns, torch.zeros_like(turns)), dim=-1)
    position = radius * torch.stack((turns.sin(), torch.zeros_like(turns), turns.cos()), dim=-1)
    poses = transform_from_axis_angle(axis, position).float()
    return CameraRig({f"cam{k + 1}": camera for k in range(num_cameras)}, poses)


def _frames(rig: CameraRig, numbers: list[int], height: int = 16, width: int = 32) -> list[Sample]:
    """Frames of noise, inverse depth between infinity and 0.6 m."""
    generator = torch.Generator().manual_seed(0)
    frames = []
    for number in numbers:
        images = {
            name: torch.rand(3, *camera.image_size, generator=generator)
            for name, camera in rig.cameras.items()
        }
        inverse_depth = torch.rand(height, width, generator=generator) / 0.6
        inverse_depth[0] = 0.0
        frames.append({"frame": f"{number:05d}", "images": images, "inverse_depth": inverse_depth})
    return frames


@pytest.fixture
def make_rig() -> Callable[..., CameraRig]:
    """Function of radius (m), number of cameras and image size."""
    return _rig


@pytest.fixture
def make_frames() -> Callable[..., list[Sample]]:
    """Function of a rig, frame numbers and the panorama's height and width."""
    return _frames


@pytest.fixture
def rig() -> CameraRig:
    return _rig()


@pytest.fixture
def frames(rig: CameraRig) -> Callable[..., list[Sample]]:
    """Function of frame numbers; frames for ``rig``."""
    return lambda *numbers, **size: _frames(rig, list(numbers), **size)
