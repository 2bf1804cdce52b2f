# SPDX-License-Identifier: Apache-2.0
"""Pictures of a checkerboard before a fisheye, rendered along exact rays."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from sphericalvision.cameras import Camera, KannalaBrandtCamera
from sphericalvision.geometry import transform_from_axis_angle
from sphericalvision.io.images import write_image
from sphericalvision.recipes.commands.calibrate import board_corners

COLUMNS, ROWS, SQUARE = 7, 5, 0.05
TRUTH = KannalaBrandtCamera(
    [118.0, 119.0], [160.3, 118.2], [-0.012, 0.003, 0.0, 0.0], (240, 320), math.radians(80)
)


def picture(camera: Camera, pose: Tensor, samples: int = 3) -> Tensor:
    """A board of black and white squares with a white border, and grey around it, (h, w, 3) uint8; exact rays."""
    height, width = camera.image_size
    offsets = (torch.arange(samples, dtype=torch.float64) + 0.5) / samples - 0.5
    shade = torch.zeros(height, width, dtype=torch.float64)
    for dv in offsets:
        for du in offsets:
            rays = camera.unproject(camera.pixel_grid(torch.float64) + torch.stack((du, dv))).directions
            normal, origin = pose[:3, 2], pose[:3, 3]
            distance = (normal @ origin) / (rays @ normal)
            local = (distance[..., None] * rays - origin) @ pose[:3, :3] / SQUARE
            x, y = local[..., 0], local[..., 1]
            square = ((x.floor() + y.floor()) % 2 == 0).double()
            inside = (x > -1) & (x < COLUMNS) & (y > -1) & (y < ROWS)
            border = (x > -1.6) & (x < COLUMNS + 0.6) & (y > -1.6) & (y < ROWS + 0.6)
            value = torch.where(inside, square, torch.where(border, 1.0, 0.4))
            shade += torch.where(distance > 0, value, 0.4)
    grey = (20 + 215 * shade / samples**2).round().to(torch.uint8)
    return grey[..., None].expand(-1, -1, 3)


def boards() -> Tensor:
    """Twelve poses of the board all over the picture, tilted."""
    step = torch.arange(12, dtype=torch.float64)
    angle, azimuth = math.radians(42) * ((step + 0.4) / 12).sqrt(), 2.4 * step
    towards = torch.stack((-azimuth.sin() * angle, azimuth.cos() * angle, 0 * step), -1)
    tilt = torch.stack((0.45 * (3 * step).sin(), 0.45 * (2 * step).cos(), 0.3 * step.sin()), -1)
    middle = board_corners(COLUMNS, ROWS, SQUARE).mean(0)
    shift = torch.eye(4).double()
    shift[:3, 3] = -middle
    away = torch.tensor([[0.0, 0.0, 0.33]]).double().expand(12, 3)
    nothing = torch.zeros(12, 3).double()
    return transform_from_axis_angle(towards, nothing) @ transform_from_axis_angle(tilt, away) @ shift


def write_boards(folder: Path) -> None:
    """The pictures of all poses as ``00.png`` and so on."""
    for index, pose in enumerate(boards()):
        write_image(folder / f"{index:02}.png", picture(TRUTH, pose).numpy())
