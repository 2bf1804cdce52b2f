# SPDX-License-Identifier: Apache-2.0
"""Camera models beside the bare evaluation of their formulas, kornia and OpenCV, in turns."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from kornia.geometry.camera import distortion_kannala_brandt as kornia_kannala_brandt
from omegaconf import DictConfig
from torch import Tensor

from sphericalvision.cameras import (
    BrownConradyCamera,
    Camera,
    DoubleSphereCamera,
    EquirectangularCamera,
    ExtendedUnifiedCamera,
    FisheyeCamera,
    KannalaBrandtCamera,
    OCamCamera,
    PinholeCamera,
    Remap,
    UnifiedCamera,
)
from sphericalvision.recipes.benchmarking import Comparison

__all__ = ["comparisons"]

SIZE, FOCAL, CENTER = (800, 800), [240.0, 241.0], [399.2, 400.7]
DISTORTION = [-0.0069, 0.0448, -0.0435, 0.0084]
"""Of a fisheye with Kannala and Brandt's model."""


def comparisons(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """Every model both ways in single and double precision; then images from one camera to another."""
    for dtype in (torch.float32, torch.float64):
        for name, (camera, bare) in _models().items():
            yield from _both_ways(name, camera.to(device, dtype), bare, config.num_points)
    yield from _images(device)


def _models() -> dict[str, tuple[Camera, Callable[[Tensor], Tensor] | None]]:
    """Cameras, and their projections as bare formulas: no checks, no validity, no care at the axis."""
    wide = math.radians(95)
    return {
        "pinhole": (PinholeCamera(FOCAL, CENTER, SIZE), _bare_pinhole),
        "Brown-Conrady, 5": (
            BrownConradyCamera(FOCAL, CENTER, [-0.2, 0.05, 1e-3, -1e-3, 0.0], SIZE),
            _bare_brown_conrady,
        ),
        "Kannala-Brandt": (KannalaBrandtCamera(FOCAL, CENTER, DISTORTION, SIZE, wide), _bare_kannala_brandt),
        "unified": (UnifiedCamera(FOCAL, CENTER, 0.9, None, SIZE), _bare_unified),
        "extended unified": (ExtendedUnifiedCamera(FOCAL, CENTER, 0.6, 1.1, SIZE), None),
        "double sphere": (DoubleSphereCamera(FOCAL, CENTER, -0.2, 0.58, SIZE, wide), None),
        "equidistant": (FisheyeCamera("equidistant", torch.tensor(FOCAL), CENTER, SIZE, wide), None),
        "OCam, exact inverse": (
            OCamCamera([-240.0, 0.0, 1.1e-3, 2e-7, 1e-10], None, CENTER, [1.0, 0.0, 0.0], SIZE, wide),
            None,
        ),
    }


def _both_ways(
    name: str, camera: Camera, bare: Callable[[Tensor], Tensor] | None, number: int
) -> Iterator[Comparison]:
    generator = torch.Generator().manual_seed(0)
    size = torch.tensor([SIZE[1] - 1, SIZE[0] - 1])
    pixels = (torch.rand(number, 2, generator=generator) * size).to(camera.device, camera.dtype)
    points = camera.unproject(pixels).directions
    label = f"{name}, {number} points, {str(camera.dtype).removeprefix('torch.')}"
    runs: dict[str, Callable[[], Any]] = {}
    if bare is not None:
        runs["bare formula"] = lambda: bare(points)
    runs["sphericalvision"] = lambda: camera.project(points)
    yield Comparison(f"project: {label}", runs, next(iter(runs)))
    yield _unproject(label, camera, pixels)


def _unproject(label: str, camera: Camera, pixels: Tensor) -> Comparison:
    runs: dict[str, Callable[[], Any]] = {"sphericalvision": lambda: camera.unproject(pixels)}
    note = ""
    matrix = np.array([[FOCAL[0], 0, CENTER[0]], [0, FOCAL[1], CENTER[1]], [0, 0, 1]])
    array = pixels.cpu().numpy()[:, None]
    if isinstance(camera, KannalaBrandtCamera):
        parameters = torch.tensor([[*FOCAL, *CENTER, *DISTORTION]]).to(pixels)
        runs = {
            "kornia": lambda: kornia_kannala_brandt.undistort_points_kannala_brandt(pixels, parameters[0]),
            **runs,
            "OpenCV": lambda: cv2.fisheye.undistortPoints(array, matrix, np.array(DISTORTION)),
        }
        note = "kornia and OpenCV answer on the plane z = 1, so not beyond 90°."
    if isinstance(camera, BrownConradyCamera):
        distortion = camera.distortion.cpu().numpy()
        runs["OpenCV"] = lambda: cv2.undistortPoints(array, matrix, distortion)
        note = "OpenCV takes five rounds of fixed-point iteration, whatever is left."
    return Comparison(f"unproject: {label}", runs, next(iter(runs)), note=note)


def _images(device: torch.device) -> Iterator[Comparison]:
    """A fisheye image to a panorama through a kept table, against the interpolation alone."""
    camera = FisheyeCamera("equidistant", torch.tensor(FOCAL), CENTER, SIZE, math.radians(95)).to(device)
    target = EquirectangularCamera((512, 1024)).to(device)
    image = torch.rand(1, 3, *SIZE, device=device)
    grid = 2 * torch.rand(1, *target.image_size, 2, device=device) - 1
    pixels = camera.project(target.unproject(target.pixel_grid()).directions).pixels
    grid = (2 * pixels / (SIZE[0] - 1) - 1)[None].to(grid)
    remap, area = Remap(camera, target).to(device), Remap(camera, target, mode="area").to(device)
    yield Comparison(
        "image of 800 x 800 to 512 x 1024, kept table",
        {
            "bare grid_sample": lambda: F.grid_sample(image, grid, align_corners=True),
            "Remap": lambda: remap(image),
            "Remap, antialiased": lambda: area(image),
        },
        "bare grid_sample",
    )


def _bare_pinhole(points: Tensor) -> Tensor:
    focal, center = points.new_tensor(FOCAL), points.new_tensor(CENTER)
    return points[..., :2] / points[..., 2:] * focal + center


def _bare_brown_conrady(points: Tensor) -> Tensor:
    k1, k2, p1, p2 = -0.2, 0.05, 1e-3, -1e-3
    x, y = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2]
    r2 = x * x + y * y
    scale = 1 + r2 * (k1 + r2 * k2)
    u = x * scale + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * scale + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return torch.stack((FOCAL[0] * u + CENTER[0], FOCAL[1] * v + CENTER[1]), -1)


def _bare_kannala_brandt(points: Tensor) -> Tensor:
    x, y, z = points.unbind(-1)
    radius = torch.hypot(x, y)
    angle = torch.atan2(radius, z)
    a2 = angle * angle
    k1, k2, k3, k4 = DISTORTION
    scale = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4)))) / radius
    return torch.stack((FOCAL[0] * scale * x + CENTER[0], FOCAL[1] * scale * y + CENTER[1]), -1)


def _bare_unified(points: Tensor) -> Tensor:
    x, y, z = points.unbind(-1)
    depth = z + 0.9 * points.norm(dim=-1)
    return torch.stack((FOCAL[0] * x / depth + CENTER[0], FOCAL[1] * y / depth + CENTER[1]), -1)
