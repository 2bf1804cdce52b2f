# SPDX-License-Identifier: Apache-2.0
"""Camera models and those of other libraries: kornia, OpenCV, and ds-msp and py360convert where they are installed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from importlib.util import find_spec

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
    RadialPolynomialCamera,
    Remap,
    UnifiedCamera,
)
from sphericalvision.recipes.speed.measuring import Comparison, Run

__all__ = ["cameras"]

SIZE, FOCAL, CENTER = (800, 800), [240.0, 241.0], [399.2, 400.7]
WIDE = math.radians(95)
DISTORTION = [-0.0069, 0.0448, -0.0435, 0.0084]
"""Of a fisheye with Kannala and Brandt's model."""
PLUMB_BOB = [-0.2, 0.05, 1e-3, -1e-3, 0.0]
DOUBLE_SPHERE = [-0.2, 0.58]
OCAM, OCAM_INVERSE, AFFINE = [-240.0, 0.0, 1.1e-3, 2e-7, 1e-10], [376.0, 235.0, -2.0, 9.0], [1.0, 1e-3, 2e-3]
ZERO, MATRIX = np.zeros(3), np.array([[FOCAL[0], 0, CENTER[0]], [0, FOCAL[1], CENTER[1]], [0, 0, 1]])

PINHOLE = (FOCAL, CENTER)
MODELS: dict[str, Callable[[], Camera]] = {
    "pinhole": partial(PinholeCamera, *PINHOLE, SIZE),
    "Brown-Conrady, 5": partial(BrownConradyCamera, *PINHOLE, PLUMB_BOB, SIZE),
    "Kannala-Brandt": partial(KannalaBrandtCamera, *PINHOLE, DISTORTION, SIZE, WIDE),
    "unified": partial(UnifiedCamera, *PINHOLE, 0.9, None, SIZE),
    "extended unified": partial(ExtendedUnifiedCamera, *PINHOLE, 0.6, 1.1, SIZE),
    "double sphere": partial(DoubleSphereCamera, *PINHOLE, DOUBLE_SPHERE[0], DOUBLE_SPHERE[1], SIZE, WIDE),
    "radial polynomial": partial(RadialPolynomialCamera, [240.0, -2.0, 12.0, -4.0], CENTER, 1.0, SIZE, WIDE),
    "OCam, inverse polynomial": partial(OCamCamera, OCAM, OCAM_INVERSE, CENTER, AFFINE, SIZE, WIDE),
    "OCam, exact inverse": partial(OCamCamera, OCAM, None, CENTER, AFFINE, SIZE, WIDE),
    "equidistant": partial(FisheyeCamera, "equidistant", torch.tensor(FOCAL), CENTER, SIZE, WIDE),
    "equirectangular": partial(EquirectangularCamera, SIZE),
}


def cameras(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """Every model both ways in single and double precision; then images from one camera to another."""
    size = torch.tensor([SIZE[1] - 1, SIZE[0] - 1])
    pixels = torch.rand(config.num_points, 2, generator=torch.Generator().manual_seed(0)) * size
    for dtype in (torch.float32, torch.float64):
        places = pixels.to(device, dtype)
        runs: dict[str, dict[str, Run]] = {"project": {}, "unproject": {}}
        for name, model in MODELS.items():
            camera = model().to(device, dtype)
            points = camera.unproject(places).directions
            runs["project"][name] = partial(camera.project, points)
            runs["unproject"][name] = partial(camera.unproject, places)
            for (verb, library), run in _others(name, points, places).items():
                runs[verb][f"{name}, {library}"] = run
        for verb, own in runs.items():
            yield Comparison(f"{verb} {config.num_points} points, {str(dtype).removeprefix('torch.')}", own)
    yield from _images(device)


def _others(name: str, points: Tensor, pixels: Tensor) -> dict[tuple[str, str], Run]:
    """The same lens in other libraries: kornia and OpenCV answer on the plane z = 1, so not beyond 90°."""
    rays, places = (values.cpu().numpy()[:, None] for values in (points, pixels))
    runs: dict[tuple[str, str], Run] = {}
    peer = {
        "Kannala-Brandt": ("KannalaBrandtModel", DISTORTION),
        "double sphere": ("DoubleSphereModel", DOUBLE_SPHERE),
    }.get(name)
    if peer and points.dtype == torch.float64 and find_spec("ds_msp"):
        model = getattr(import_module("ds_msp.models"), peer[0])(*FOCAL, *CENTER, *peer[1])
        runs["project", "ds-msp"] = partial(model.project, rays[:, 0])
        runs["unproject", "ds-msp"] = partial(model.unproject, places[:, 0])
    if name == "Kannala-Brandt":
        parameters, lens = torch.tensor([*FOCAL, *CENTER, *DISTORTION]).to(points), np.array(DISTORTION)
        plane = points[..., :2] / points[..., 2:]
        kornia = kornia_kannala_brandt
        runs["project", "kornia"] = partial(kornia.distort_points_kannala_brandt, plane, parameters)
        runs["unproject", "kornia"] = partial(kornia.undistort_points_kannala_brandt, pixels, parameters)
        runs["project", "OpenCV"] = partial(cv2.fisheye.projectPoints, rays, ZERO, ZERO, MATRIX, lens)
        runs["unproject", "OpenCV"] = partial(cv2.fisheye.undistortPoints, places, MATRIX, lens)
    elif name == "Brown-Conrady, 5":  # back by five rounds of fixed-point iteration, whatever is left
        lens = np.array(PLUMB_BOB)
        runs["project", "OpenCV"] = partial(cv2.projectPoints, rays, ZERO, ZERO, MATRIX, lens)
        runs["unproject", "OpenCV"] = partial(cv2.undistortPoints, places, MATRIX, lens)
    return runs


def _images(device: torch.device) -> Iterator[Comparison]:
    """A fisheye image to a panorama and that to a view of 90°, by kept tables, against the interpolation alone."""
    fisheye = MODELS["equidistant"]().to(device)
    panorama = EquirectangularCamera((512, 1024)).to(device)
    view = PinholeCamera([256.0, 256.0], [255.5, 255.5], (512, 512)).to(device)
    for source, target in ((fisheye, panorama), (panorama, view)):
        height, width = source.image_size
        image = torch.rand(1, 3, height, width, device=device)
        pixels = source.project(target.unproject(target.pixel_grid()).directions).pixels
        grid = (2 * pixels / torch.tensor([width - 1, height - 1], device=device) - 1)[None]
        remap, area = Remap(source, target).to(device), Remap(source, target, mode="area").to(device)
        runs: dict[str, Run] = {
            "bare grid_sample": partial(F.grid_sample, image, grid, align_corners=True),
            "Remap": partial(remap, image),
            "Remap, antialiased": partial(area, image),
        }
        if target is view and find_spec("py360convert"):  # which makes its table anew in every call
            array = image[0].movedim(0, -1).contiguous().cpu().numpy()
            e2p = import_module("py360convert").e2p
            runs["py360convert"] = partial(e2p, array, (90, 90), 0, 0, (512, 512))
        sizes = " to ".join("{} x {}".format(*camera.image_size) for camera in (source, target))
        yield Comparison(f"image of {sizes}, kept table", runs)
