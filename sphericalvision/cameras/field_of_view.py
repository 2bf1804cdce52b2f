# SPDX-License-Identifier: Apache-2.0
"""How far a camera sees around its axis, through image border, model and ``max_angle`` alike."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.base import Camera, check_single
from sphericalvision.core import check_type

_STEPS = 256  # angles looked at along each azimuth before the edge is bisected


class FieldOfView(NamedTuple):
    """Angles in radians between opposite edges of the view, measured through the optical axis."""

    horizontal: float
    """From the left to the right edge."""
    vertical: float
    """From the upper to the lower edge."""
    widest: float
    """The largest in any direction; the diagonal of an image without dark corners."""


def directions_around_axis(angle: Tensor, azimuth: Tensor) -> Tensor:
    """Unit directions (*, 3) at ``angle`` (*) from the axis; azimuth (*) 0 is to the right, π/2 down."""
    angle, azimuth = torch.broadcast_tensors(angle, azimuth)
    flat = torch.sin(angle)
    return torch.stack((flat * torch.cos(azimuth), flat * torch.sin(azimuth), torch.cos(angle)), dim=-1)


def cap(limit: float, count: int, like: Camera) -> Float[Tensor, "n 3"]:
    """Directions (count, 3) within ``limit`` of the axis, on a spiral of equal areas."""
    step = torch.arange(count, dtype=torch.float64, device=like.device)
    angle = 2 * torch.asin(math.sin(limit / 2) * ((step + 0.5) / count).sqrt())
    return directions_around_axis(angle, step * (math.pi * (3 - math.sqrt(5))))


@torch.no_grad()
def visible_angle(camera: Camera, azimuth: Float[Tensor, "*azimuths"]) -> Float[Tensor, "*azimuths"]:
    """The widest angle from the axis (*) that ``camera`` sees in the half planes at ``azimuth`` (*), in radians.

    Azimuth 0 is to the right and π/2 down, as in the image. 0 where nothing is seen.

    Examples:
        >>> from sphericalvision.cameras import PinholeCamera
        >>> camera = PinholeCamera([100.0, 100.0], [99.5, 49.5], (100, 200))
        >>> visible_angle(camera, torch.tensor([0.0, math.pi / 2], dtype=torch.float64)).rad2deg()
        tensor([45.0000, 26.5651], dtype=torch.float64)
    """
    check_single(camera)
    camera, azimuth = camera.to(torch.float64), azimuth.double()
    limit = float(camera.max_angle)
    steps = torch.linspace(0, limit, _STEPS, dtype=torch.float64, device=azimuth.device)
    seen = camera.project(directions_around_axis(steps, azimuth.unsqueeze(-1))).valid
    last = (seen * torch.arange(1, _STEPS + 1, device=azimuth.device)).amax(-1) - 1
    low = steps[last.clamp_min(0)]
    high = steps[(last + 1).clamp_max(_STEPS - 1)]
    for _ in range(48):
        center = (low + high) / 2
        sees = camera.project(directions_around_axis(center, azimuth)).valid
        low, high = torch.where(sees, center, low), torch.where(sees, high, center)
    return torch.where(last < 0, 0.0, torch.where(last == _STEPS - 1, limit, low))


def field_of_view(camera: Camera) -> FieldOfView:
    """The angles that ``camera`` sees.

    Raises:
        ArgumentError: the camera is a batch.

    Examples:
        >>> from sphericalvision.cameras import FisheyeCamera
        >>> fisheye = FisheyeCamera.from_field_of_view((600, 800), math.radians(190))
        >>> [round(math.degrees(angle)) for angle in field_of_view(fisheye)]
        [190, 190, 190]
    """
    check_type("camera", camera, Camera)
    azimuth = torch.arange(360, dtype=torch.float64, device=camera.device) * (math.pi / 180)
    angle = visible_angle(camera, azimuth)
    across = angle[:180] + angle[180:]
    return FieldOfView(float(across[0]), float(across[90]), float(across.max()))


@torch.no_grad()
def focal_length_on_axis(camera: Camera) -> Float[Tensor, " 2"]:
    """Pixels per radian at the optical axis along u and v, (2,), float64: comparable between models.

    NaN where the camera's model does not reach the axis.

    Examples:
        >>> from sphericalvision.cameras import UnifiedCamera
        >>> focal_length_on_axis(UnifiedCamera([300.0, 300.0], [255.5, 255.5], 0.5, None, (512, 512))).round()
        tensor([200., 200.], dtype=torch.float64)
    """
    check_single(camera)
    # Between one and two steps on either side: inverse polynomials of OCam files often miss the very centre.
    step = torch.tensor([-2e-4, -1e-4, 1e-4, 2e-4], dtype=torch.float64, device=camera.device)
    along_u, along_v = step.new_zeros(4, 3), step.new_zeros(4, 3)
    along_u[:, 0], along_v[:, 1] = step.sin(), step.sin()
    points = torch.stack((along_u, along_v))
    points[..., 2] = step.cos()
    pixels, valid = camera.to(torch.float64)._project(points)
    u, v = pixels[0, :, 0], pixels[1, :, 1]
    slope = torch.stack([(x[1] - x[0] + x[3] - x[2]) / 2e-4 for x in (u, v)])
    return torch.where(valid.all(), slope, torch.nan)
