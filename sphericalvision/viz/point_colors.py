# SPDX-License-Identifier: Apache-2.0
"""Colours of points of the world, blended from the images of the cameras that see them."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ShapeError

__all__ = ["point_colors"]


def point_colors(
    rig: CameraRig, images: Mapping[str, Shaped[Tensor, "c _ _"]], points: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "c n"], Bool[Tensor, " n"]]:
    """Return colours ``(c, n)`` of points ``(n, 3)``, zero where no camera looks, and where some camera does ``(n,)``.

    Cameras that see a point nearer to their axis count more. What stands in the way is not known.

    Raises:
        ShapeError: the images' names are not the cameras'.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> rig = ring_rig(2, image_size=(8, 8))
        >>> colors, seen = point_colors(rig, {name: torch.ones(3, 8, 8) for name in rig.names}, 3 * torch.eye(3))
        >>> colors.shape, seen.tolist()
        (torch.Size([3, 3]), [True, True, True])
    """
    if set(images) != set(rig.names):
        raise ShapeError(f"images: expected those of the cameras {list(rig.names)}, got {list(images)}")
    if not len(points):
        return points.new_zeros(next(iter(images.values())).shape[0], 0), torch.zeros(0, dtype=torch.bool)
    projection = rig.project(points)
    channels = next(iter(images.values())).shape[0]
    total, weights = points.new_zeros(channels, len(points)), points.new_zeros(len(points))
    for index, (name, camera) in enumerate(rig.cameras.items()):
        (which,) = projection.valid[index].nonzero(as_tuple=True)
        colors = camera.interpolate(images[name].to(points), projection.pixels[index][which])
        ray = points[which] - rig.positions[index]
        forward = (ray @ rig.axes[index] / ray.norm(dim=-1) + 1) / 2
        weight = forward.clamp(min=0.05) ** 8  # what is behind a panorama's axis counts, too
        total = total.index_add(1, which, weight * colors)
        weights = weights.index_add(0, which, weight)
    return total / weights.clamp(min=1e-12), weights > 0
