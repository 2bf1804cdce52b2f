# SPDX-License-Identifier: Apache-2.0
"""Checks of what cameras and rigs are made of: sizes of images, intrinsics, angles, poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.precision import HALF
from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.geometry.directions import is_traced

__all__ = [
    "check_poses",
    "check_precision",
    "check_rotation",
    "checked_angle",
    "checked_numbers",
    "checked_size",
]


def check_precision(dtype: torch.dtype) -> None:
    """Raise ``ArgumentError`` for half precision, which cannot hold intrinsics."""
    if dtype in HALF:
        raise ArgumentError(
            f"dtype: cameras keep their intrinsics in float32 or float64, got {dtype}; points and images may be in "
            "half precision"
        )


def checked_numbers(name: str, value: Any, like: Float[Tensor, " ..."]) -> Float[Tensor, " ..."]:
    """A tensor of finite numbers."""
    try:
        tensor = torch.as_tensor(value, dtype=like.dtype, device=like.device)
    except (TypeError, ValueError, RuntimeError):
        raise ArgumentError(f"{name}: expected numbers, got {value!r:.80}") from None
    if not (is_traced() or bool(tensor.isfinite().all())):
        raise ArgumentError(f"{name}: expected finite numbers, got {tensor.tolist()!s:.200}")
    return tensor


def checked_angle(
    max_angle: float | Float[Tensor, " ..."], like: Float[Tensor, " ..."]
) -> Float[Tensor, "*batch"]:
    """The limit of a field of view as a tensor, in radians from the optical axis."""
    angle = checked_numbers("max_angle", max_angle, like)
    if not angle.numel() or not bool(((angle > 0) & (angle <= torch.pi + 1e-6)).all()):
        raise ArgumentError(
            f"max_angle: expected radians from the optical axis in (0, π], got {max_angle}; it is half the field of "
            "view, e.g. math.radians(110) for a lens of 220°"
        )
    return angle


def checked_size(image_size: Sequence[int]) -> tuple[int, int]:
    """(height, width) of an image, as whole numbers above 0."""
    if len(image_size) != 2 or any(int(side) != side or side < 1 for side in image_size):
        raise ArgumentError(f"image_size: expected (height, width) in pixels, got {image_size!r}")
    return int(image_size[0]), int(image_size[1])


def check_poses(names: list[str], poses: Float[Tensor, "*rigs n 4 4"]) -> None:
    """Raise unless there is a rigid transform ``(*b, n, 4, 4)`` for each camera; errors name the camera."""
    if not names:
        raise ArgumentError("cameras: expected at least one camera, got none")
    if poses.ndim < 3 or tuple(poses.shape[-3:]) != (len(names), 4, 4):
        raise ShapeError(
            f"world_from_camera: expected shape (*b, {len(names)}, 4, 4) for {len(names)} cameras, "
            f"got {tuple(poses.shape)}"
        )
    detached = poses.detach()
    finite = detached.isfinite().flatten(-2).all(-1).reshape(-1, len(names)).all(0)
    for name, fine in zip(names, finite.tolist(), strict=True):
        if not fine:
            raise ArgumentError(
                f"world_from_camera: the pose of {name} has NaN or infinite numbers; correct it"
            )
    check_rotation("world_from_camera", detached[..., :3, :3])


def check_rotation(name: str, rotation: Float[Tensor, "*batch 3 3"]) -> None:
    """Raise ``ArgumentError`` unless all of these ``(*, 3, 3)`` turn and do nothing else."""
    rotation = rotation.detach().double()
    eye = torch.eye(3, dtype=torch.float64, device=rotation.device)
    rigid = ((rotation @ rotation.mT - eye).abs().amax() < 1e-3) and bool(
        (torch.linalg.det(rotation) > 0).all()
    )
    if not rigid:
        raise ArgumentError(
            f"{name}: expected rotations (3 x 3, orthonormal, determinant +1), but these stretch, mirror or hold NaN"
        )
