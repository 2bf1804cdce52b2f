# SPDX-License-Identifier: Apache-2.0
"""Pinhole views of a panorama, or of any other camera's image, by yaw, pitch and roll."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.models.equirectangular import EquirectangularCamera
from sphericalvision.cameras.models.pinhole import PinholeCamera
from sphericalvision.cameras.remapping.remap import remap
from sphericalvision.core import ArgumentError, ShapeError, check_tensor
from sphericalvision.geometry.directions import holds
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


def checked_angles(
    name: str, views: Float[Tensor, "n 3"] | Sequence[Sequence[float]]
) -> Float[Tensor, "n 3"]:
    """Yaw, pitch and roll (n, 3) in float64.

    Examples:
        >>> checked_angles("views", [(0.0, 0.5, 0.0)]).shape
        torch.Size([1, 3])
    """
    angles = torch.as_tensor(views, dtype=torch.float64)
    if angles.ndim != 2 or angles.shape[-1] != 3:
        raise ShapeError(f"{name}: expected (n, 3) as yaw, pitch and roll, got shape {tuple(angles.shape)}")
    if not holds(angles.abs() <= 2 * math.pi + 1e-3):
        raise ArgumentError(
            f"{name}: expected radians within ±2π, got {float(angles.abs().max()):g}; are these degrees?"
        )
    return angles


def perspective_views(
    image: Shaped[Tensor, "*images c h w"],
    views: Float[Tensor, "n 3"] | Sequence[Sequence[float]],
    field_of_view: float | Sequence[float] = math.pi / 2,
    image_size: Sequence[int] = (512, 512),
    *,
    source: Camera | None = None,
    mode: str = "bilinear",
) -> Shaped[Tensor, "*batch n c rows columns"]:
    """What pinhole cameras see (*b, n, c, h', w') that look into a panorama (*b, c, h, w) in n directions.

    ``sphere.views`` keeps their cameras, and brings what is made of the views back together.

    Args:
        image: (*b, c, h, w), a whole panorama, twice as wide as high, or whatever ``source`` takes.
        views: (n, 3), yaw to the right, pitch upwards and roll clockwise, in radians.
        field_of_view: of a view's shorter side, or (horizontal, vertical), in radians, below π.
        image_size: (height, width) of the views.
        source: camera that took the image: any lens, or a panorama of another size, ``EquirectangularCamera(...)``.
        mode: as in ``remap``; ``"area"`` where the views are coarser than the image.

    Raises:
        ShapeError: the views are not (n, 3), or the image is not of the source's size, or without a source no panorama.
        ArgumentError: angles beyond ±2π, a field of view that no pinhole has, or an unknown mode.

    Examples:
        >>> panorama = EquirectangularCamera((64, 128)).pixel_grid().movedim(-1, 0)  # its own pixel coordinates
        >>> right_and_up = perspective_views(panorama, [(torch.pi / 2, 0, 0), (0, torch.pi / 4, 0)], 1.0, (31, 31))
        >>> right_and_up[:, :, 15, 15].round(decimals=3).tolist()
        [[95.5, 31.5], [63.5, 15.5]]
    """
    angles = checked_angles("views", views)
    if source is None:
        check_tensor("image", image, "(*b, c, h, w)")
        if image.ndim < 3 or image.shape[-1] != 2 * image.shape[-2]:
            raise ShapeError(
                f"image: expected a whole panorama (*b, c, h, 2 h), got {tuple(image.shape)}; source=... says which "
                "camera took it, EquirectangularCamera((h, w)) for a panorama of another size"
            )
        source = EquirectangularCamera(tuple(image.shape[-2:]))
    target = PinholeCamera.from_field_of_view(image_size, field_of_view)
    view_from_source = rotation_from_yaw_pitch_roll(angles).mT.to(image.device)
    return remap(image.unsqueeze(-4), source, target, view_from_source.float(), mode)
