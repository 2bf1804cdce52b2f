# SPDX-License-Identifier: Apache-2.0
"""A capture of a rig one of whose cameras was turned after it was calibrated."""

from __future__ import annotations

from pathlib import Path

import torch

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.geometry import transform_from_axis_angle
from sphericalvision.scenes import make_scene, render_rig
from tests.recipes.tiny import write_capture

__all__ = ["FRAMES", "KNOCKED", "true_rig", "write_knocked_capture"]

FRAMES = 4
KNOCKED = ring_rig(3, radius=0.2, image_size=(128, 128))
"""As it is calibrated."""


def true_rig(degrees: float = 1.0) -> CameraRig:
    """As it is: the second camera looks further down."""
    turn = torch.tensor([-torch.pi * degrees / 180, 0.0, 0.0])
    poses = KNOCKED.world_from_camera.clone()
    poses[1] = poses[1] @ transform_from_axis_angle(turn, torch.zeros(3))
    return CameraRig(KNOCKED.cameras, poses)


def write_knocked_capture(folder: Path, degrees: float = 1.0) -> None:
    """``rig.yaml``, as calibrated, and ``cam1/00000.png`` and so on."""
    rig = true_rig(degrees)
    frames = (render_rig(make_scene("floating", seed=5 + frame), rig, 1) for frame in range(FRAMES))
    write_capture(folder, KNOCKED, *frames, file="{camera}/{frame:05d}.png")
