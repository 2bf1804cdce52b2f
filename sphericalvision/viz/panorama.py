# SPDX-License-Identifier: Apache-2.0
"""Panoramas as pictures: depth with a scale in metres, errors, and colours stitched from a rig's images."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ShapeError
from sphericalvision.icosphere import Icosphere, level_from_num_vertices
from sphericalvision.shapes import check_shapes
from sphericalvision.sphere import Equirectangular
from sphericalvision.viz.color import (
    DEPTH_MAP,
    ERROR_MAP,
    Picture,
    depth_ticks,
    depth_to_color,
    error_to_color,
    fade,
)
from sphericalvision.viz.figure import add_scale_bar
from sphericalvision.viz.pointcloud import point_colors


@check_shapes
def depth_panorama(
    depth: Float[Tensor, "H W"],
    min_depth: float,
    max_depth: float = math.inf,
    strength: Float[Tensor, "H W"] | None = None,
) -> Picture:
    """Colour a depth panorama and put a scale in metres below it.

    Args:
        depth: ``(H, W)`` metres along the rays; infinity is far away, NaN and values up to zero are unknown
            (grey).
        min_depth: metres, the near (red) end of the scale.
        max_depth: metres, the far (blue) end; the scale is even in inverse depth, so infinity is a good end.
        strength: ``(H, W)`` 0 to 1: saturation of the colour of each depth; the less, the greyer.
            ``confidence_strength`` computes it from a confidence.

    Returns:
        uint8 ``(H + margins, W, 3)``, RGB.

    Examples:
        >>> depth_panorama(torch.full((32, 64), 2.0), min_depth=0.5).shape[1:]
        (640, 3)
    """
    ticks = depth_ticks(min_depth, max_depth)
    colors = depth_to_color(depth, min_depth, max_depth)
    if strength is None:
        return add_scale_bar(colors, DEPTH_MAP, ticks, "depth (m)")
    label = "depth (m); the greyer, the less sure"
    return add_scale_bar(fade(colors, strength), DEPTH_MAP, ticks, label, faded=True)


def confidence_strength(
    confidence: Float[Tensor, "*shape"], seen: Bool[Tensor, "*shape"]
) -> Float[Tensor, "*shape"]:
    """Return the strength of colour for a confidence: 1 from 0.9 on, 0 where fewer than two cameras see the point.

    Examples:
        >>> sure, seen = torch.tensor([0.0, 0.65, 0.95, 0.95]), torch.tensor([True, True, True, False])
        >>> confidence_strength(sure, seen)
        tensor([0.1500, 0.5750, 1.0000, 0.0000])
    """
    certainty = ((confidence - _UNSURE) / (_SURE - _UNSURE)).clamp(0, 1)
    return torch.where(seen, _LEAST + (1 - _LEAST) * certainty, 0.0)


_LEAST = 0.15
"""Strength of the least confidence."""
_UNSURE, _SURE = 0.4, 0.9
"""Confidences of the least and of full strength: nearly all points that networks see well have more than 0.9."""


@check_shapes
def error_panorama(error: Float[Tensor, "H W"], max_error: float, label: str = "error (% of N)") -> Picture:
    """Colour a panorama of errors and put a scale below it.

    Args:
        error: ``(H, W)``, in the unit of the label: percent of the number of hypotheses, metres, ...; NaN
            is unknown (grey), the sign does not count.
        max_error: the bright end of the scale; larger errors look like it.
        label: quantity and unit below the scale.

    Returns:
        uint8 ``(H + margins, W, 3)``, RGB.

    Examples:
        >>> error_panorama(torch.rand(32, 64), max_error=1.0).shape[1:]
        (640, 3)
    """
    ticks = [(k / 5, f"{max_error * k / 5:.3g}") for k in range(5)] + [(1.0, f"≥ {max_error:.3g}")]
    return add_scale_bar(error_to_color(error, max_error), ERROR_MAP, ticks, label)


def icosphere_to_panorama(values: Float[Tensor, "*batch V"], height: int) -> Float[Tensor, "*batch H W"]:
    """Interpolate values on an icosphere to an equirectangular panorama, linearly in each triangle.

    Interpolate inverse depth rather than depth: it is finite, and planes are smoother in it.

    Args:
        values: ``(*, V)``, floating point.
        height: rows; the panorama has twice as many columns.

    Returns:
        ``(*, height, 2 * height)``.

    Examples:
        >>> icosphere_to_panorama(torch.ones(3, 42), height=10).shape
        torch.Size([3, 10, 20])
    """
    level = level_from_num_vertices(values.shape[-1])
    directions = Equirectangular(height, 2 * height, torch.float64, values.device).directions
    grid = Icosphere(level, torch.float64, values.device)
    samples = grid.sample(values.reshape(-1, values.shape[-1]), directions.reshape(-1, 3))
    return samples.reshape(*values.shape[:-1], height, 2 * height)


def rgb_panorama(
    rig: CameraRig,
    images: Mapping[str, Shaped[Tensor, "c _ _"]],
    height: int,
    depth: Float[Tensor, "H W"] | float = math.inf,
) -> tuple[Float[Tensor, "c H W"], Bool[Tensor, "H W"]]:
    """Stitch a rig's images to a panorama seen from the rig's centre.

    Each point of the panorama, at its depth, has the colours of all cameras that see it, weighted more near their axis.
    Occlusion is not known, so edges may show ghosts.

    Args:
        rig: unbatched.
        images: camera name -> ``(c, h, w)``.
        height: rows; the panorama has twice as many columns.
        depth: metres along the rays from the centre, ``(height, 2 * height)`` or one number; unknown depth
            (NaN or up to zero) and infinity are looked up far away.

    Returns:
        Colours ``(c, height, 2 * height)``, zero where no camera looks, and where some camera does
        ``(height, 2 * height)``.

    Raises:
        ShapeError: depth of another shape.
        ArgumentError: the images' names are not the cameras'.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> rig = ring_rig(2, image_size=(16, 16))
        >>> colors, known = rgb_panorama(rig, {name: torch.ones(3, 16, 16) for name in rig.names}, height=8)
        >>> colors.shape, known.shape
        (torch.Size([3, 8, 16]), torch.Size([8, 16]))
    """
    dtype, device = rig.world_from_camera.dtype, rig.world_from_camera.device
    directions = _rays(height, dtype, device)
    far = torch.as_tensor(depth, dtype=dtype, device=device).reshape(-1, 1)
    if far.numel() not in (1, len(directions)):
        raise ShapeError(
            f"depth: expected ({height}, {2 * height}) or a number, got {tuple(torch.as_tensor(depth).shape)}"
        )
    far = torch.where((far > 0) & (far < _FAR), far, _FAR)
    points = rig.center + far * directions
    colors, seen = point_colors(rig, images, points)
    return colors.reshape(-1, height, 2 * height), seen.reshape(height, 2 * height)


@lru_cache(maxsize=4)  # frames of a video share them
@torch.inference_mode(False)
def _rays(height: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    return Equirectangular(height, 2 * height, dtype, device).directions.reshape(-1, 3)


_FAR = 1e4  # metres; no rig is so large that its cameras would see a difference beyond
