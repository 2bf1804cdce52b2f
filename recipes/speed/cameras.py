# SPDX-License-Identifier: Apache-2.0
"""Camera models and those of other libraries: kornia, OpenCV, and ds-msp and py360convert where they are installed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from importlib.util import find_spec
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
    RadialPolynomialCamera,
    Remap,
    UnifiedCamera,
)
from sphericalvision.recipes.speed.measuring import Comparison

__all__ = ["cameras", "models"]

SIZE, FOCAL, CENTER = (800, 800), [240.0, 241.0], [399.2, 400.7]
WIDE = math.radians(95)
DISTORTION = [-0.0069, 0.0448, -0.0435, 0.0084]
"""Of a fisheye with Kannala and Brandt's model."""
PLUMB_BOB = [-0.2, 0.05, 1e-3, -1e-3, 0.0]
DOUBLE_SPHERE = [-0.2, 0.58]
OCAM, OCAM_INVERSE, AFFINE = [-240.0, 0.0, 1.1e-3, 2e-7, 1e-10], [376.0, 235.0, -2.0, 9.0], [1.0, 1e-3, 2e-3]
MATRIX = np.array([[FOCAL[0], 0, CENTER[0]], [0, FOCAL[1], CENTER[1]], [0, 0, 1]])

Runs = dict[str, Callable[[], Any]]


def cameras(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """Every model both ways in single and double precision; then images from one camera to another."""
    generator = torch.Generator().manual_seed(0)
    size = torch.tensor([SIZE[1] - 1, SIZE[0] - 1])
    pixels = torch.rand(config.num_points, 2, generator=generator) * size
    for dtype in (torch.float32, torch.float64):
        runs: dict[str, Runs] = {"project": {}, "unproject": {}}
        for name, camera in models().items():
            camera, places = camera.to(device, dtype), pixels.to(device, dtype)
            points = camera.unproject(places).directions
            for verb, values in (("project", points), ("unproject", places)):
                runs[verb][name] = partial(getattr(camera, verb), values)
                runs[verb] |= {f"{name}, {other}": run for other, run in _others(name, verb, values).items()}
        for verb, own in runs.items():
            yield Comparison(f"{verb} {config.num_points} points, {str(dtype).removeprefix('torch.')}", own)
    yield from _images(device)


def models() -> dict[str, Camera]:
    """One camera of every kind."""
    pinhole = (FOCAL, CENTER)
    examples: dict[str, Camera] = {
        "pinhole": PinholeCamera(*pinhole, SIZE),
        "Brown-Conrady, 5": BrownConradyCamera(*pinhole, PLUMB_BOB, SIZE),
        "Kannala-Brandt": KannalaBrandtCamera(*pinhole, DISTORTION, SIZE, WIDE),
        "unified": UnifiedCamera(*pinhole, 0.9, None, SIZE),
        "extended unified": ExtendedUnifiedCamera(*pinhole, 0.6, 1.1, SIZE),
        "double sphere": DoubleSphereCamera(*pinhole, DOUBLE_SPHERE[0], DOUBLE_SPHERE[1], SIZE, WIDE),
        "radial polynomial": RadialPolynomialCamera([240.0, -2.0, 12.0, -4.0], CENTER, 1.0, SIZE, WIDE),
        "OCam, inverse polynomial": OCamCamera(OCAM, OCAM_INVERSE, CENTER, AFFINE, SIZE, WIDE),
        "OCam, exact inverse": OCamCamera(OCAM, None, CENTER, AFFINE, SIZE, WIDE),
        "equirectangular": EquirectangularCamera(SIZE),
    }
    for projection in ("equidistant", "equisolid", "stereographic", "orthographic"):
        widest = min(WIDE, math.radians(89)) if projection == "orthographic" else WIDE
        examples[projection] = FisheyeCamera(projection, torch.tensor(FOCAL), CENTER, SIZE, widest)
    return examples


def _others(name: str, verb: str, values: Tensor) -> Runs:
    """The same lens in other libraries: kornia and OpenCV answer on the plane z = 1, so not beyond 90°."""
    array, zero = values.cpu().numpy()[:, None], np.zeros(3)
    kannala_brandt, brown_conrady = np.array(DISTORTION), np.array(PLUMB_BOB)
    runs: Runs = {}
    if name == "Kannala-Brandt":
        parameters = torch.tensor([*FOCAL, *CENTER, *DISTORTION]).to(values)
        if verb == "project":
            plane, lens = values[..., :2] / values[..., 2:], (zero, zero, MATRIX, kannala_brandt)
            runs["kornia"] = partial(kornia_kannala_brandt.distort_points_kannala_brandt, plane, parameters)
            runs["OpenCV"] = partial(cv2.fisheye.projectPoints, array, *lens)
        else:
            runs["kornia"] = partial(
                kornia_kannala_brandt.undistort_points_kannala_brandt, values, parameters
            )
            runs["OpenCV"] = partial(cv2.fisheye.undistortPoints, array, MATRIX, kannala_brandt)
    elif name.startswith("Brown-Conrady"):
        if verb == "project":
            runs["OpenCV"] = partial(cv2.projectPoints, array, zero, zero, MATRIX, brown_conrady)
        else:  # five rounds of fixed-point iteration, whatever is left
            runs["OpenCV"] = partial(cv2.undistortPoints, array, MATRIX, brown_conrady)
    peers = {
        "Kannala-Brandt": ("KannalaBrandtModel", DISTORTION),
        "double sphere": ("DoubleSphereModel", DOUBLE_SPHERE),
    }
    if name in peers and values.dtype == torch.float64 and find_spec("ds_msp"):
        kind, coefficients = peers[name]
        peer = getattr(import_module("ds_msp.models"), kind)(*FOCAL, *CENTER, *coefficients)
        runs["ds-msp"] = partial(getattr(peer, verb), values.cpu().numpy())
    return runs


def _images(device: torch.device) -> Iterator[Comparison]:
    """A fisheye image to a panorama and that to a view of 90°, by kept tables, against the interpolation alone."""
    fisheye = FisheyeCamera("equidistant", torch.tensor(FOCAL), CENTER, SIZE, WIDE).to(device)
    panorama = EquirectangularCamera((512, 1024)).to(device)
    view = PinholeCamera([256.0, 256.0], [255.5, 255.5], (512, 512)).to(device)
    for source, target in ((fisheye, panorama), (panorama, view)):
        height, width = source.image_size
        image = torch.rand(1, 3, height, width, device=device)
        pixels = source.project(target.unproject(target.pixel_grid()).directions).pixels
        grid = (2 * pixels / torch.tensor([width - 1, height - 1], device=device) - 1)[None]
        remap, area = Remap(source, target).to(device), Remap(source, target, mode="area").to(device)
        runs: Runs = {
            "bare grid_sample": partial(F.grid_sample, image, grid, align_corners=True),
            "Remap": partial(remap, image),
            "Remap, antialiased": partial(area, image),
        }
        if target is view and find_spec("py360convert"):  # which makes its table anew in every call
            array = image[0].movedim(0, -1).contiguous().cpu().numpy()
            runs["py360convert"] = partial(
                import_module("py360convert").e2p, array, (90, 90), 0, 0, (512, 512)
            )
        sizes = " to ".join("{} x {}".format(*camera.image_size) for camera in (source, target))
        yield Comparison(f"image of {sizes}, kept table", runs)
