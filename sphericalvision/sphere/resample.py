# SPDX-License-Identifier: Apache-2.0
"""Resampling between any two of icosphere, panorama and camera image, with a rotation in between."""

from __future__ import annotations

import torch
from torch import Tensor

from sphericalvision.cameras import Camera
from sphericalvision.core import ArgumentError, ShapeError, check_choice
from sphericalvision.sphere.base import SphereGrid

__all__ = ["resample", "resample_mask"]


def resample(
    values: Tensor,
    source: SphereGrid | Camera,
    target: SphereGrid | Camera,
    rotation: Tensor | None = None,
    mode: str = "bilinear",
    fill: float = 0.0,
) -> Tensor:
    """Resample values from one grid or camera to another.

    Args:
        values: ``(*b, c, *source_shape)``; the shape of a camera is its ``image_size``.
        source: where the values are given.
        target: where they are wanted.
        rotation: ``(3, 3)``, target_from_source: what was seen in direction d is then seen in ``rotation @
        d``. mode: ``"bilinear"`` (linear in each triangle of an icosphere), or ``"nearest"`` for labels, of
        any dtype. fill: value where the source or the target sees nothing, see ``resample_mask``.

    Returns:
        ``(*b, c, *target_shape)``; differentiable in values and rotation for ``"bilinear"``.

    Raises:
        ShapeError: if the values do not lie on the source or the rotation is no 3 x 3 matrix.
        ArgumentError: if source or target is neither a grid nor a camera, or the mode is unknown.

    Examples:
        >>> from sphericalvision.icosphere import Icosphere
        >>> from sphericalvision.sphere import Equirectangular
        >>> ico = Icosphere(4)
        >>> height = resample(-ico.vertices[None, :, 1], ico, Equirectangular(8, 16))
        >>> height.shape, bool(height[0, 0].min() > 0.97)
        (torch.Size([1, 8, 16]), True)
    """
    check_choice("mode", mode, ("bilinear", "nearest"))
    shape, target_shape = _shape(source, "source"), _shape(target, "target")
    if values.ndim <= len(shape) or tuple(values.shape[-len(shape) :]) != shape:
        size = ", ".join(map(str, shape))
        raise ShapeError(f"values: expected shape (*b, c, {size}) for this source, got {tuple(values.shape)}")
    directions, valid = _target_directions(target, rotation)
    if isinstance(source, Camera):
        if mode == "bilinear":
            result, seen = source.sample(values, directions)
        else:
            result, seen = _nearest_pixel(values, source, directions)
        valid = valid & seen
    elif mode == "bilinear":
        result = source.sample(values, directions)
    else:
        result = values.flatten(-len(shape))[..., source.nearest(directions)]
    return torch.where(valid, result, fill).to(values.dtype).unflatten(-1, target_shape)


def resample_mask(
    source: SphereGrid | Camera, target: SphereGrid | Camera, rotation: Tensor | None = None
) -> Tensor:
    """Return where ``resample`` finds values, a bool tensor of the target's shape: all but what a camera
    cannot see.

    Raises:
        ArgumentError: if source or target is neither a grid nor a camera.

    Examples:
        >>> from sphericalvision.icosphere import Icosphere
        >>> from sphericalvision.sphere import Equirectangular
        >>> resample_mask(Icosphere(2), Equirectangular(8, 16)).all()
        tensor(True)
    """
    _, target_shape = _shape(source, "source"), _shape(target, "target")
    directions, valid = _target_directions(target, rotation)
    if isinstance(source, Camera):
        valid = valid & source.project(directions).valid
    return valid.view(target_shape)


def _shape(grid: SphereGrid | Camera, name: str) -> tuple[int, ...]:
    """Return the shape of values on a grid or of a camera's image."""
    if isinstance(grid, Camera):
        if grid.batch_shape:
            raise ArgumentError(
                f"{name}: expected a single camera, got a batch of shape {grid.batch_shape}; "
                "take one with Camera.select"
            )
        return grid.image_size
    if not isinstance(grid, SphereGrid):
        raise ArgumentError(
            f"{name}: expected a SphereGrid (Icosphere, Equirectangular) or a Camera, got {type(grid).__name__}"
        )
    return tuple(grid.shape)


def _target_directions(target: SphereGrid | Camera, rotation: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return where the target looks, in the source's frame ``(n, 3)``, and whether it does ``(n,)``."""
    if isinstance(target, Camera):
        directions, valid = target.unproject(target.pixel_grid().flatten(0, 1))
    else:
        directions = target.directions.reshape(-1, 3)
        valid = torch.ones(len(directions), dtype=torch.bool, device=directions.device)
    if rotation is None:
        return directions, valid
    if tuple(rotation.shape) != (3, 3):
        raise ShapeError(f"rotation: expected shape (3, 3), got {tuple(rotation.shape)}")
    # target_from_source turns the other way: its transpose acts on column vectors, itself on rows.
    return directions.to(rotation) @ rotation, valid


def _nearest_pixel(image: Tensor, camera: Camera, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Return the pixels ``(*b, c, n)`` that directions ``(n, 3)`` fall on, and whether the camera sees them."""
    height, width = camera.image_size
    pixels, valid = camera.project(directions)
    column, row = torch.where(valid[:, None], pixels, 0.0).round().long().unbind(-1)
    index = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
    return image.flatten(-2)[..., index], valid
