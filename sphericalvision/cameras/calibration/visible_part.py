# SPDX-License-Identifier: Apache-2.0
"""The field of view of cameras whose file does not tell it: as far as the image, or the mask, shows."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool
from torch import Tensor

from sphericalvision.cameras.base import AnyCamera, Camera
from sphericalvision.cameras.calibration.parsing import errors_of_file
from sphericalvision.core import FileFormatError


@torch.no_grad()
def widest_angle(camera: Camera, mask: Bool[Tensor, "h w"] | None = None) -> float:
    """The largest angle from the axis, in radians, at which a usable pixel of the image looks.

    Formats that do not tell a field of view get it from here. It is as good as the mask: an image without one is
    taken to be usable up to its corners, or as far towards them as the model is defined.
    """
    camera = camera.to("cpu", torch.float64)
    if mask is not None:
        pixels = mask.cpu().nonzero().flip(-1).to(torch.float64)
        angles, valid = _angles(camera, pixels)
        return float(torch.where(valid, angles, 0.0).max()) if len(pixels) else 0.0
    border = _border_pixels(camera.image_size)
    angles, valid = _angles(camera, border)
    if bool(valid.all()):
        return float(angles.max())
    limit = float(camera.max_angle)
    return limit if limit < math.pi else float(_angles_at_the_edge(camera, border).max())


def _angles(camera: Camera, pixels: Tensor) -> tuple[Tensor, Tensor]:
    directions, valid = camera.unproject(pixels)
    return torch.atan2(directions[..., :2].norm(dim=-1), directions[..., 2]), valid


def _border_pixels(image_size: tuple[int, int]) -> Tensor:
    """Corners and other pixels of the outermost rows and columns, (n, 2)."""
    height, width = image_size
    across = torch.linspace(0, width - 1, min(width, 128), dtype=torch.float64).round()
    down = torch.linspace(0, height - 1, min(height, 128), dtype=torch.float64).round()
    rows = [torch.stack((across, torch.full_like(across, v)), -1) for v in (0, height - 1)]
    columns = [torch.stack((torch.full_like(down, u), down), -1) for u in (0, width - 1)]
    return torch.cat(rows + columns)


def _angles_at_the_edge(camera: Camera, border: Tensor) -> Tensor:
    """Angles at the last pixels that the model knows on the way from the principal point to the border."""
    forward = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    inner, far = camera.project(forward).pixels.expand_as(border), border
    widest = torch.zeros_like(border[:, 0])
    for fraction in (1.0, *([0.5] * 30)):
        pixels = inner + fraction * (far - inner)
        angles, valid = _angles(camera, pixels)
        widest = torch.where(valid, torch.maximum(widest, angles), widest)
        inner = torch.where(valid.unsqueeze(-1), pixels, inner)
        far = torch.where(valid.unsqueeze(-1), far, pixels)
    return widest


def bounded(
    camera: AnyCamera, max_angle: float | None, where: str, mask: Bool[Tensor, "h w"] | None = None
) -> AnyCamera:
    """``camera`` with ``max_angle``, or where that is ``None``, as much as its image shows; a panorama as it is."""
    if not camera.intrinsic_names:
        return camera
    if max_angle is None:
        with errors_of_file(where):
            max_angle = widest_angle(camera, mask)
        if not max_angle > 0:
            raise FileFormatError(f"{where}: no pixel of the image can be turned into a direction")
    return camera.with_max_angle(min(max_angle, float(camera.max_angle)))
