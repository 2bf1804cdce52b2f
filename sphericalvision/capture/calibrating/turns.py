# SPDX-License-Identifier: Apache-2.0
"""Cameras of a rig turned where they are."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.rig import CameraRig

_NONE = math.radians(0.05)
"""Turns below are no turns when it comes to which cameras are right."""
_ROUNDS = 10


def rotations(vectors: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return rotation matrices of rotation vectors by Rodrigues' formula, smooth at 0, where a search begins.

    Examples:
        >>> forward = torch.tensor([0.0, 0.0, 1.0])
        >>> (rotations(torch.tensor([0.0, torch.pi / 2, 0.0])) @ forward).round().abs().tolist()  # goes to the right
        [1.0, 0.0, 0.0]
    """
    angle = (vectors.square().sum(-1) + 1e-30).sqrt()[..., None, None]
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    skew = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).unflatten(-1, (3, 3))
    rotation = torch.eye(3).to(vectors) + skew * (angle.sin() / angle)
    return rotation + skew @ skew * (2 * (angle / 2).sin().square() / angle.square())


def turned(rig: CameraRig, turns: Float[Tensor, "n 3"]) -> CameraRig:
    """Return a rig with each camera turned by a rotation vector in the world, radians, about its own position."""
    poses = rig.world_from_camera.detach().clone()
    poses[:, :3, :3] = rotations(turns.to(poses.device, torch.float64)) @ poses[:, :3, :3].double()
    return rig.replaced(world_from_camera=poses)


def rightness(turns: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Return weights of cameras, 1 for those that did not turn: cameras that turned far hardly count.

    Examples:
        >>> rightness(torch.tensor([[0.0, 0.0, 0.0], [0.0001, 0.0, 0.0], [0.02, 0.0, 0.0]])).round(decimals=2)
        tensor([1.0000, 0.9900, 0.0000])
    """
    squared_angles = turns.square().sum(-1)
    return 1 / (1 + squared_angles / max(float(squared_angles.median()), _NONE**2))


def about_most(turns: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Return turns but for the one that most cameras share: no image tells a turn of the whole rig.

    Examples:
        >>> shared = torch.tensor([[0.001, 0.0, 0.0], [0.001, 0.0, 0.0], [0.001, 0.02, 0.0]])
        >>> about_most(shared)[:, 0].abs().max() < 1e-6, about_most(shared)[2, 1] > 0.019
        (tensor(True), tensor(True))
    """
    for _ in range(_ROUNDS):
        right = rightness(turns)
        turns = turns - right @ turns / right.sum()
    return turns
