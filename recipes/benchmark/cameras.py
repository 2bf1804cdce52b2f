# SPDX-License-Identifier: Apache-2.0
"""Camera models beside other libraries, in turns."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial

import torch
import torch.nn.functional as F
from omegaconf import DictConfig

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
    RadialPolynomialCamera,
    Remap,
    UnifiedCamera,
)
from sphericalvision.recipes.benchmark.camera_peers import Peers, perspective_peers
from sphericalvision.recipes.benchmark.measuring import Comparison

__all__ = ["cameras", "comparisons"]

SIZE, FOCAL, CENTER = (800, 800), [240.0, 241.0], [399.2, 400.7]
DISTORTION = [-0.0069, 0.0448, -0.0435, 0.0084]
"""Of a fisheye with Kannala and Brandt's model."""
WIDE = math.radians(95)
PLUMB_BOB = [-0.2, 0.05, 1e-3, -1e-3, 0.0]
DOUBLE_SPHERE = [-0.2, 0.58]
RADIAL = [240.0, -2.0, 12.0, -4.0]
OCAM, OCAM_INVERSE, AFFINE = [-240.0, 0.0, 1.1e-3, 2e-7, 1e-10], [376.0, 235.0, -2.0, 9.0], [1.0, 1e-3, 2e-3]


def comparisons(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """Every model both ways in single and double precision; then images from one camera to another."""
    peers = Peers(FOCAL, CENTER, DISTORTION, PLUMB_BOB, DOUBLE_SPHERE)
    for dtype in (torch.float32, torch.float64):
        for name, camera in cameras().items():
            yield from _both_ways(name, camera.to(device, dtype), config.num_points, peers)
    yield from _images(device)


def cameras() -> dict[str, Camera]:
    """One camera of every kind."""
    pinhole = (FOCAL, CENTER)
    found: dict[str, Camera] = {
        "pinhole": PinholeCamera(*pinhole, SIZE),
        "Brown-Conrady, 5": BrownConradyCamera(*pinhole, PLUMB_BOB, SIZE),
        "Kannala-Brandt": KannalaBrandtCamera(*pinhole, DISTORTION, SIZE, WIDE),
        "unified": UnifiedCamera(*pinhole, 0.9, None, SIZE),
        "extended unified": ExtendedUnifiedCamera(*pinhole, 0.6, 1.1, SIZE),
        "double sphere": DoubleSphereCamera(*pinhole, DOUBLE_SPHERE[0], DOUBLE_SPHERE[1], SIZE, WIDE),
        "radial polynomial": RadialPolynomialCamera(RADIAL, CENTER, 1.0, SIZE, WIDE),
        "OCam, inverse polynomial": OCamCamera(OCAM, OCAM_INVERSE, CENTER, AFFINE, SIZE, WIDE),
        "OCam, exact inverse": OCamCamera(OCAM, None, CENTER, AFFINE, SIZE, WIDE),
        "equirectangular": EquirectangularCamera(SIZE),
    }
    for projection in ("equidistant", "equisolid", "stereographic", "orthographic"):
        widest = min(WIDE, math.radians(89)) if projection == "orthographic" else WIDE
        found[projection] = FisheyeCamera(projection, torch.tensor(FOCAL), CENTER, SIZE, widest)
    return found


def _both_ways(name: str, camera: Camera, number: int, peers: Peers) -> Iterator[Comparison]:
    generator = torch.Generator().manual_seed(0)
    size = torch.tensor([SIZE[1] - 1, SIZE[0] - 1])
    pixels = (torch.rand(number, 2, generator=generator) * size).to(camera.max_angle)
    points = camera.unproject(pixels).directions
    label = f"{name}, {number} points, {str(camera.dtype).removeprefix('torch.')}"
    for verb, values in (("project", points), ("unproject", pixels)):
        others, note = peers.runs(name, verb, values)
        runs = {"sphericalvision": partial(getattr(camera, verb), values), **others}
        reference = next((run for run in ("kornia", "OpenCV") if run in runs), "sphericalvision")
        yield Comparison(f"{verb}: {label}", runs, reference, note=note)


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
    view = PinholeCamera([256.0, 256.0], [255.5, 255.5], (512, 512))  # 90°
    panorama = torch.rand(3, 512, 1024, device=device)
    look = Remap(target, view.to(device)).to(device)
    grid = 2 * torch.rand(1, 512, 512, 2, device=device) - 1
    others, note = perspective_peers(panorama, 90, view.image_size)
    yield Comparison(
        "panorama of 512 x 1024 to 512 x 512, kept table",
        {
            "bare grid_sample": lambda: F.grid_sample(panorama[None], grid, align_corners=True),
            "Remap": lambda: look(panorama[None]),
            **others,
        },
        "bare grid_sample",
        note=note,
    )
