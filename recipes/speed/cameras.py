# SPDX-License-Identifier: Apache-2.0
"""Camera models and those of other libraries: kornia, OpenCV, and ds-msp and py360convert where they are installed."""

import math
from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from importlib.util import find_spec

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from kornia.geometry.camera import distortion_kannala_brandt as kornia
from omegaconf import DictConfig
from torch import Tensor

from sphericalvision import cameras as models
from sphericalvision.recipes.speed.measuring import Comparison, Run

SIZE, FOCAL, CENTER, WIDE = (800, 800), [240.0, 241.0], [399.2, 400.7], math.radians(95)
MATRIX = np.array([[FOCAL[0], 0, CENTER[0]], [0, FOCAL[1], CENTER[1]], [0, 0, 1]])
FISHEYE, PLUMB_BOB = [-0.0069, 0.0448, -0.0435, 0.0084], [-0.2, 0.05, 1e-3, -1e-3, 0.0]
"""Coefficients of Kannala and Brandt's model, and of Brown and Conrady's."""
OCAM, OCAM_INVERSE, AFFINE = [-240.0, 0.0, 1.1e-3, 2e-7, 1e-10], [376.0, 235.0, -2.0, 9.0], [1.0, 1e-3, 2e-3]

MODELS: dict[str, Callable[[], models.Camera]] = {
    "pinhole": partial(models.PinholeCamera, FOCAL, CENTER, SIZE),
    "Brown-Conrady, 5": partial(models.BrownConradyCamera, FOCAL, CENTER, PLUMB_BOB, SIZE),
    "Kannala-Brandt": partial(models.KannalaBrandtCamera, FOCAL, CENTER, FISHEYE, SIZE, WIDE),
    "unified": partial(models.UnifiedCamera, FOCAL, CENTER, 0.9, None, SIZE),
    "extended unified": partial(models.ExtendedUnifiedCamera, FOCAL, CENTER, 0.6, 1.1, SIZE),
    "double sphere": partial(models.DoubleSphereCamera, FOCAL, CENTER, -0.2, 0.58, SIZE, WIDE),
    "radial polynomial": partial(
        models.RadialPolynomialCamera, [240.0, -2.0, 12.0, -4.0], CENTER, 1.0, SIZE, WIDE
    ),
    "OCam, inverse polynomial": partial(models.OCamCamera, OCAM, OCAM_INVERSE, CENTER, AFFINE, SIZE, WIDE),
    "OCam, exact inverse": partial(models.OCamCamera, OCAM, None, CENTER, AFFINE, SIZE, WIDE),
    "equidistant": partial(models.FisheyeCamera, "equidistant", torch.tensor(FOCAL), CENTER, SIZE, WIDE),
    "equirectangular": partial(models.EquirectangularCamera, SIZE),
}


def cameras(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """Every model both ways in single and double precision; then images from one camera to another."""
    size = torch.tensor([SIZE[1] - 1, SIZE[0] - 1])
    random = torch.rand(config.num_points, 2, generator=torch.Generator().manual_seed(0)) * size
    for dtype in (torch.float32, torch.float64):
        pixels = random.to(device, dtype)
        ways: dict[str, tuple[Run, Run]] = {}
        for name, model in MODELS.items():
            camera = model().to(device, dtype)
            points = camera.unproject(pixels).directions
            ways[name] = partial(camera.project, points), partial(camera.unproject, pixels)
            ways |= {f"{name}, {library}": runs for library, runs in _others(name, points, pixels).items()}
        for column, verb in enumerate(("project", "unproject")):
            title = f"{verb} {config.num_points} points, {str(dtype).removeprefix('torch.')}"
            yield Comparison(title, {name: runs[column] for name, runs in ways.items()})
    yield from _images(device)


def _others(name: str, points: Tensor, pixels: Tensor) -> dict[str, tuple[Run, Run]]:
    """Projection and unprojection of the same lens by other libraries.

    Those of kornia and OpenCV are on the plane z = 1, so not beyond 90°. OpenCV inverts Brown and Conrady's model by
    five rounds of fixed-point iteration, whatever error remains.
    """
    zero = np.zeros(3)
    rays, image = (values.cpu().numpy()[:, None] for values in (points, pixels))
    runs: dict[str, tuple[Run, Run]] = {}
    if name == "Kannala-Brandt":
        parameters, lens = torch.tensor([*FOCAL, *CENTER, *FISHEYE]).to(points), np.array(FISHEYE)
        runs["kornia"] = (
            partial(kornia.distort_points_kannala_brandt, points[..., :2] / points[..., 2:], parameters),
            partial(kornia.undistort_points_kannala_brandt, pixels, parameters),
        )
        runs["OpenCV"] = (
            partial(cv2.fisheye.projectPoints, rays, zero, zero, MATRIX, lens),
            partial(cv2.fisheye.undistortPoints, image, MATRIX, lens),
        )
    elif name == "Brown-Conrady, 5":
        lens = np.array(PLUMB_BOB)
        runs["OpenCV"] = (
            partial(cv2.projectPoints, rays, zero, zero, MATRIX, lens),
            partial(cv2.undistortPoints, image, MATRIX, lens),
        )
    peers = {
        "Kannala-Brandt": ("KannalaBrandtModel", FISHEYE),
        "double sphere": ("DoubleSphereModel", [-0.2, 0.58]),
    }
    if name in peers and points.dtype == torch.float64 and find_spec("ds_msp"):
        peer, coefficients = peers[name]
        model = getattr(import_module("ds_msp.models"), peer)(*FOCAL, *CENTER, *coefficients)
        runs["ds-msp"] = partial(model.project, rays[:, 0]), partial(model.unproject, image[:, 0])
    return runs


def _images(device: torch.device) -> Iterator[Comparison]:
    """A fisheye image to a panorama, that to a view of 90°, and a panorama to half its size, by cached tables."""
    fisheye, large = MODELS["equidistant"]().to(device), models.EquirectangularCamera((1024, 2048)).to(device)
    panorama = models.EquirectangularCamera((512, 1024)).to(device)
    view = models.PinholeCamera([256.0, 256.0], [255.5, 255.5], (512, 512)).to(device)
    for source, target in ((fisheye, panorama), (panorama, view), (large, panorama)):
        height, width = source.image_size
        image = torch.rand(1, 3, height, width, device=device)
        pixels = source.project(target.unproject(target.pixel_grid()).directions).pixels
        grid = (2 * pixels / torch.tensor([width - 1, height - 1], device=device) - 1)[None]
        runs: dict[str, Run] = {
            "bare grid_sample": partial(F.grid_sample, image, grid, align_corners=True),
            "Remap": partial(models.Remap(source, target).to(device), image),
            "Remap, antialiased": partial(models.Remap(source, target, mode="area").to(device), image),
        }
        array = image[0].movedim(0, -1).contiguous().cpu().numpy()
        if source is large:
            runs["OpenCV, INTER_AREA"] = partial(cv2.resize, array, (1024, 512), interpolation=cv2.INTER_AREA)
        if target is view and find_spec("py360convert"):  # which computes its table again in every call
            perspective = import_module("py360convert").e2p
            runs["py360convert"] = partial(perspective, array, (90, 90), 0, 0, (512, 512))
        sizes = " to ".join("{} x {}".format(*camera.image_size) for camera in (source, target))
        yield Comparison(f"image of {sizes}, cached table", runs)
