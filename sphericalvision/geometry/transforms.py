# SPDX-License-Identifier: Apache-2.0
"""Rigid transforms as 4 x 4 matrices; ``a_from_b`` takes b-coordinates to a-coordinates."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.core import ArgumentError
from sphericalvision.geometry.directions import broadcast_shapes, holds
from sphericalvision.kernels import full_precision
from sphericalvision.shapes import check_shapes


def _assemble(rotation: Tensor, translation: Tensor) -> Tensor:
    batch = broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    upper = torch.cat((rotation.expand(*batch, 3, 3), translation.expand(*batch, 3).unsqueeze(-1)), dim=-1)
    last = upper.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*upper.shape[:-2], 1, 4)
    return torch.cat((upper, last), dim=-2)


@check_shapes
@full_precision
def invert_transform(a_from_b: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """The rigid transform ``b_from_a`` (*, 4, 4); exact for rotations, no linear solve.

    Examples:
        >>> shift = torch.eye(4)
        >>> shift[0, 3] = 2.0
        >>> invert_transform(shift)[0, 3].item()
        -2.0
    """
    rotation = a_from_b[..., :3, :3].mT
    return _assemble(rotation, -(rotation @ a_from_b[..., :3, 3:]).squeeze(-1))


@check_shapes
@full_precision
def transform_points(
    a_from_b: Float[Tensor, "*poses 4 4"], points: Float[Tensor, "*points 3"]
) -> Float[Tensor, "*batch 3"]:
    """Take ``points`` (*, n, 3) in b-coordinates to a-coordinates (*, n, 3) with ``a_from_b`` (*, 4, 4).

    One point (3,) becomes (*, 3), one for each of the transforms.

    Examples:
        >>> shift = torch.eye(4)
        >>> shift[2, 3] = 1.0
        >>> transform_points(shift, torch.zeros(1, 3)).tolist()
        [[0.0, 0.0, 1.0]]
    """
    if points.ndim == 1:
        return transform_points(a_from_b, points[None]).squeeze(-2)
    return points @ a_from_b[..., :3, :3].mT + a_from_b[..., None, :3, 3]


@check_shapes
def transform_from_axis_angle(
    axis_angle: Float[Tensor, "*angles 3"], translation: Float[Tensor, "*translations 3"]
) -> Float[Tensor, "*batch 4 4"]:
    """Rigid transform (*, 4, 4) from a rotation vector (*, 3) in radians and a translation (*, 3).

    Examples:
        >>> turn_right = transform_from_axis_angle(torch.tensor([0.0, torch.pi / 2, 0.0]), torch.zeros(3))
        >>> forward = torch.tensor([[0.0, 0.0, 1.0]])
        >>> transform_points(turn_right, forward)[0, 0].item()  # forward becomes right, which is +x
        1.0
    """
    from kornia.geometry.conversions import axis_angle_to_rotation_matrix  # a second to import

    rotation = axis_angle_to_rotation_matrix(axis_angle.reshape(-1, 3))
    return _assemble(rotation.reshape(*axis_angle.shape[:-1], 3, 3), translation)


@check_shapes
def axis_angle_from_transform(
    a_from_b: Float[Tensor, "*batch 4 4"],
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"]]:
    """Rotation vector (*, 3) in radians and translation (*, 3) of ``a_from_b`` (*, 4, 4).

    Examples:
        >>> axis_angle_from_transform(torch.eye(4))[0].tolist()
        [0.0, 0.0, 0.0]
    """
    from kornia.geometry.conversions import rotation_matrix_to_axis_angle

    axis_angle = rotation_matrix_to_axis_angle(a_from_b[..., :3, :3].reshape(-1, 3, 3))
    return axis_angle.reshape(*a_from_b.shape[:-2], 3), a_from_b[..., :3, 3]


@check_shapes
def transform_from_quaternion(
    quaternion: Float[Tensor, "*quaternions 4"], translation: Float[Tensor, "*translations 3"]
) -> Float[Tensor, "*batch 4 4"]:
    """Rigid transform (*, 4, 4) from a quaternion (*, 4) as (w, x, y, z) of any length and a translation (*, 3).

    Examples:
        >>> transform_from_quaternion(torch.tensor([1.0, 0.0, 0.0, 0.0]), torch.ones(3))[0].tolist()
        [1.0, 0.0, 0.0, 1.0]
    """
    if not holds((quaternion != 0).any(-1)):
        raise ArgumentError("quaternion: expected (w, x, y, z) of any length but zero, got zeros")
    from kornia.geometry.conversions import quaternion_to_rotation_matrix

    return _assemble(quaternion_to_rotation_matrix(quaternion), translation)
