# SPDX-License-Identifier: Apache-2.0
"""Rotations of views by yaw, pitch and roll."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.kernels import full_precision


@full_precision
def rotation_from_yaw_pitch_roll(angles: Float[Tensor, "*views 3"]) -> Float[Tensor, "*views 3 3"]:
    """Rotations (*, 3, 3), source_from_view, of a view that is yawed, then pitched, then rolled, (*, 3) in radians.

    Yaw turns to the right, pitch upwards, and roll clockwise as seen from behind the camera.

    Examples:
        >>> up = rotation_from_yaw_pitch_roll(torch.tensor([0.0, torch.pi / 2, 0.0]))
        >>> (up @ torch.tensor([0.0, 0.0, 1.0])).round().int().tolist()  # up is -y
        [0, -1, 0]
    """
    yaw, pitch, roll = (_turn(angles[..., i], axis) for i, axis in enumerate(((2, 0), (1, 2), (0, 1))))
    return yaw @ pitch @ roll


def _turn(angle: Tensor, plane: tuple[int, int]) -> Tensor:
    """A rotation (*, 3, 3) that takes the first axis of a plane towards the second."""
    rows = torch.eye(3, dtype=angle.dtype, device=angle.device).expand(*angle.shape, 3, 3).clone()
    a, b = plane
    rows[..., a, a] = rows[..., b, b] = angle.cos()
    rows[..., b, a], rows[..., a, b] = angle.sin(), -angle.sin()
    return rows
