# SPDX-License-Identifier: Apache-2.0
"""Images of a rig's cameras looked up in directions of the world."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor

from sphericalvision.cameras.base import Camera
from sphericalvision.core import ArgumentError, ShapeError, check_last_dim
from sphericalvision.geometry import bilinear_sample

if TYPE_CHECKING:
    from sphericalvision.cameras.rig import CameraRig

__all__ = ["sample_sphere"]


def sample_sphere(
    rig: CameraRig,
    images: Mapping[str, Tensor] | Sequence[Tensor],
    directions: Tensor,
    fill: float = 0.5,
    antialias: bool = False,
) -> tuple[Tensor, Tensor]:
    """The function behind ``CameraRig.sample_sphere``, which describes it.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> rig = ring_rig(4, image_size=(64, 64))
        >>> values, valid = sample_sphere(rig, [torch.ones(3, 64, 64)] * 4, torch.tensor([[0.0, 0.0, 1.0]]))
        >>> values.shape, valid[:, 0].tolist()  # only the back camera does not see what is in front
        (torch.Size([4, 3, 1]), [True, True, False, True])
    """
    check_last_dim("directions", directions, 3)
    values, valid = [], []
    for index, (name, image) in enumerate(_in_order(rig, images).items()):
        camera = rig.cameras[name]
        if image.ndim < 3 or tuple(image.shape[-2:]) != camera.image_size:
            raise ShapeError(
                f"images[{name!r}]: expected shape (*b, c, {camera.image_size[0]}, {camera.image_size[1]}) as "
                f"calibrated, got {tuple(image.shape)}"
            )
        world_from_camera = rig.world_from_camera[..., index, :3, :3].to(directions)
        pixels, seen = camera.project(directions @ world_from_camera)
        pixels = torch.where(seen.unsqueeze(-1), pixels, 0.0)
        if name in rig.masks:
            usable = rig.masks[name].to(pixels).unsqueeze(-3)
            seen = seen & (bilinear_sample(usable, pixels).squeeze(-2) > 0.999)
        value = _look_up(camera, image, pixels, _shrinking(camera, directions) if antialias else 1)
        values.append(torch.where(seen.unsqueeze(-2), value, fill))
        valid.append(seen)
    return torch.stack(values, -3), torch.stack(valid, -2)


def _in_order(rig: CameraRig, images: Mapping[str, Tensor] | Sequence[Tensor]) -> dict[str, Tensor]:
    if isinstance(images, Mapping):
        if set(images) != set(rig.cameras):
            raise ArgumentError(
                f"images: expected one for each of {', '.join(rig.names)}, got {', '.join(map(str, images))}"
            )
        return {name: images[name] for name in rig.names}
    if len(images) != len(rig):
        raise ArgumentError(f"images: expected {len(rig)}, one for each camera, got {len(images)}")
    return dict(zip(rig.names, images, strict=True))


def _shrinking(camera: Camera, directions: Tensor) -> int:
    """How many pixels in a row lie between neighbouring directions, on average, at least 1."""
    spacing = math.sqrt(4 * math.pi / directions.shape[-2])
    pixel = 2 * float(camera.max_angle.max()) / min(camera.image_size)
    return max(1, int(spacing / pixel))


def _look_up(camera: Camera, image: Tensor, pixels: Tensor, shrink: int) -> Tensor:
    """Interpolated values, of the image averaged over squares of ``shrink`` pixels if that is more than 1."""
    if shrink > 1:
        flat = image.reshape(-1, *image.shape[-3:])
        small = F.avg_pool2d(flat, shrink, ceil_mode=True)
        image, pixels = small.reshape(*image.shape[:-2], *small.shape[-2:]), (pixels + 0.5) / shrink - 0.5
    return camera._interpolate(image, pixels)
