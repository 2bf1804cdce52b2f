# SPDX-License-Identifier: Apache-2.0
"""How far two calibrations of one camera lie apart, by the angle from the axis."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.base import Camera, check_single
from sphericalvision.cameras.field_of_view import directions_around_axis, visible_angle
from sphericalvision.core import ArgumentError, check_type

_AZIMUTHS = 180
_STEP = math.radians(10)


class CameraDifference(NamedTuple):
    """Means and largest values of rings around the axis, NaN for rings that not both cameras see."""

    angles: Float[Tensor, " n"]
    """Radians from the axis."""
    pixels: Float[Tensor, " n"]
    """Mean distance of the pixels of one direction."""
    max_pixels: Float[Tensor, " n"]
    """The largest."""
    turn: Float[Tensor, " n"]
    """Mean angle in radians between the directions of one pixel."""
    max_turn: Float[Tensor, " n"]
    """The largest."""


@torch.no_grad()
def compare_cameras(first: Camera, second: Camera, angles: Sequence[float] | None = None) -> CameraDifference:
    """How far two cameras' pixels of the same directions, and directions of the same pixels, lie apart.

    Both are taken to look the same way: a turn of the camera between two calibrations counts as a difference.

    Args:
        first: a single camera; where it sees a direction counts.
        second: one of the same image size, of any model.
        angles: radians from the axis; every 10°, and the widest that both see, when not given.

    Raises:
        ArgumentError: a batch, other image sizes, or angles beyond π.

    Examples:
        >>> from sphericalvision.cameras import FisheyeCamera
        >>> first = FisheyeCamera("equidistant", [100.0, 100.0], [127.5, 127.5], (256, 256), 1.2)
        >>> second = FisheyeCamera("equidistant", [101.0, 101.0], [127.5, 127.5], (256, 256), 1.2)
        >>> compare_cameras(first, second, [0.0, 0.5, 1.0]).pixels
        tensor([0.0000, 0.5000, 1.0000], dtype=torch.float64)
    """
    for name, camera in (("first", first), ("second", second)):
        check_type(name, camera, Camera)
        check_single(camera)
    if first.image_size != second.image_size:
        raise ArgumentError(
            f"second: expected {first.image_size[0]} x {first.image_size[1]} pixels (height x width) as the first, got "
            f"{second.image_size[0]} x {second.image_size[1]}; second.resized(first.image_size) has them"
        )
    first, second = first.to("cpu", torch.float64), second.to("cpu", torch.float64)
    azimuth = torch.arange(_AZIMUTHS, dtype=torch.float64) * (2 * math.pi / _AZIMUTHS)
    if angles is None:
        widest = float(visible_angle(first, azimuth).minimum(visible_angle(second, azimuth)).max())
        angles = [*(_STEP * k for k in range(math.ceil(widest / _STEP - 1e-3))), widest]
    rings = torch.tensor(list(angles), dtype=torch.float64)
    if not bool(((rings >= 0) & (rings < 3.1416)).all()):
        raise ArgumentError(f"angles: expected radians from 0 to π, got {rings.tolist()}; are these degrees?")
    directions = directions_around_axis(rings.unsqueeze(-1), azimuth)
    pixels, seen = first.project(directions)
    others, other_seen = second.project(directions)
    valid = seen & other_seen
    distance = (pixels - others).norm(dim=-1)
    rays, looks = second.unproject(pixels)
    angle = torch.atan2(torch.linalg.cross(rays, directions).norm(dim=-1), (rays * directions).sum(-1))
    return CameraDifference(rings, *_mean_and_most(distance, valid), *_mean_and_most(angle, valid & looks))


def _mean_and_most(values: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and largest (n,) of values (n, k) where they count."""
    most = torch.where(counts, values, -math.inf).amax(-1)
    return torch.where(counts, values, torch.nan).nanmean(-1), torch.where(most.isfinite(), most, torch.nan)
