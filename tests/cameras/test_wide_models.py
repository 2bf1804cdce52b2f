# SPDX-License-Identifier: Apache-2.0
"""The atan, division and thin prism models against their papers' formulas, written once more, and against COLMAP."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from sphericalvision.cameras import (
    AtanCamera,
    Camera,
    DivisionCamera,
    KannalaBrandtCamera,
    ThinPrismFisheyeCamera,
    convert,
)
from tests.cameras.calibration_samples import assert_projects, directions, double, kannala_brandt

FOCAL, CENTER, SIZE = [100.0, 110.0], [499.5, 299.5], (600, 1000)


def prism(
    x: Any, y: Any, p1: float, p2: float, s1: float, s2: float, s3: float, s4: float
) -> tuple[Any, Any]:
    r2 = x * x + y * y
    return (
        2 * p1 * x * y + p2 * (r2 + 2 * x * x) + s1 * r2 + s2 * r2 * r2,
        2 * p2 * x * y + p1 * (r2 + 2 * y * y) + s3 * r2 + s4 * r2 * r2,
    )


def thin_prism(rays: np.ndarray, k: list[float], terms: list[float], composition: str) -> np.ndarray:
    x, y, z = rays.T
    radius = np.hypot(x, y)
    scale = np.arctan2(radius, z) / np.where(radius > 0, radius, 1)
    px, py = x * scale, y * scale
    growth = 1 + sum(c * (px * px + py * py) ** i for i, c in enumerate(k, start=1))
    qx, qy = px * growth, py * growth
    tx, ty = prism(qx, qy, *terms) if composition == "sequential" else prism(px, py, *terms)
    return np.stack((FOCAL[0] * (qx + tx) + CENTER[0], FOCAL[1] * (qy + ty) + CENTER[1]), -1)


K = [0.01, 0.02, -0.003, 0.004, -0.0005, 0.0001]
TERMS = [0.0031, -0.0042, 0.0051, -0.0006, 0.0072, 0.0008]


def lens(composition: str, size: int = 6, terms: list[float] = TERMS) -> ThinPrismFisheyeCamera:
    values = double(FOCAL, CENTER, K[:size], terms[:2], terms[2:])
    return ThinPrismFisheyeCamera(*values, SIZE, composition=composition)


@pytest.mark.parametrize("composition", ["sequential", "additive"])
def test_thin_prism_is_its_formula(composition: str) -> None:
    rays = directions(100.0)
    assert_projects(lens(composition), thin_prism(rays, K, TERMS, composition), rays)


def test_thin_prism_without_terms_is_kannala_brandt() -> None:
    rays = directions(100.0)
    flat = ThinPrismFisheyeCamera(*double(FOCAL, CENTER, K, [0.0] * 2, [0.0] * 4), SIZE)
    assert_projects(flat, kannala_brandt(rays, *FOCAL, *CENTER, *K), rays)
    assert_projects(
        KannalaBrandtCamera(*double(FOCAL, CENTER, K), SIZE), kannala_brandt(rays, *FOCAL, *CENTER, *K), rays
    )


def test_atan_is_its_formula_and_goes_on_beyond_90_degrees() -> None:
    omega = 0.93
    rays = directions(85.0)
    x, y, z = rays.T
    radius = np.hypot(x, y) / z
    scale = np.arctan(2 * radius * np.tan(omega / 2)) / omega / np.where(radius > 0, radius, 1) / z
    expected = np.stack((FOCAL[0] * x * scale + CENTER[0], FOCAL[1] * y * scale + CENTER[1]), -1)
    camera = AtanCamera(*double(FOCAL, CENTER, omega), SIZE)
    assert_projects(camera, expected, rays)
    angle = torch.linspace(0.01, 3.1, 500, dtype=torch.float64)
    points = torch.stack((angle.sin(), 0 * angle, angle.cos()), -1)
    radii = camera.project(points).pixels[:, 0] - CENTER[0]
    assert (radii.diff() > 0).all()
    assert radii[-1] < FOCAL[0] * math.pi / omega


@pytest.mark.parametrize("distortion", [[-0.2], [0.05], [-0.2, 0.01, -0.001]])
def test_division_undoes_its_formula(distortion: list[float]) -> None:
    """Pixels are divided, which is the closed direction; the ray of each projects to where it came from."""
    camera = DivisionCamera(*double(FOCAL, CENTER, distortion), SIZE)
    u, v = np.meshgrid(np.arange(350.0, 650.0, 37.0), np.arange(150.0, 450.0, 29.0))
    x, y = (u - CENTER[0]) / FOCAL[0], (v - CENTER[1]) / FOCAL[1]
    below = 1 + sum(c * (x * x + y * y) ** i for i, c in enumerate(distortion, start=1))
    rays = np.stack((x, y, below), -1).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    pixels = np.stack((u, v), -1).reshape(-1, 2)
    found = camera.unproject(torch.from_numpy(pixels))
    assert found.valid.all()
    np.testing.assert_allclose(found.directions.numpy(), rays, atol=1e-12)
    assert_projects(camera, pixels, rays)


def test_division_of_one_parameter_is_solved_by_the_quadratic_formula() -> None:
    rays = directions(80.0)
    x, y, z = rays.T
    lam, r = -0.2, np.hypot(x, y) / z
    scale = 2 / (1 + np.sqrt(1 - 4 * lam * r * r)) / z
    expected = np.stack((FOCAL[0] * x * scale + CENTER[0], FOCAL[1] * y * scale + CENTER[1]), -1)
    assert_projects(DivisionCamera(*double(FOCAL, CENTER, [lam]), SIZE), expected, rays)


COLMAP_LENSES: dict[str, tuple[Camera, list[float]]] = {
    "FOV": (AtanCamera(*double(FOCAL, CENTER, 0.93), SIZE), [0.93]),
    "DIVISION": (DivisionCamera(*double(FOCAL, CENTER, [-0.2]), SIZE), [-0.2]),
    "THIN_PRISM_FISHEYE": (
        lens("additive", 4, [0.0031, -0.0042, 0.0051, 0.0, 0.0072, 0.0]),
        [0.01, 0.02, 0.0031, -0.0042, -0.003, 0.004, 0.0051, 0.0072],
    ),
    "RAD_TAN_THIN_PRISM_FISHEYE": (lens("sequential"), [*K, TERMS[1], TERMS[0], *TERMS[2:]]),
}


@pytest.mark.parametrize("model", COLMAP_LENSES)
def test_colmaps_own_lenses_agree(model: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    camera, more = COLMAP_LENSES[model]
    theirs = pycolmap.Camera(model=model, width=1000, height=600, params=[*FOCAL, 500.0, 300.0, *more])
    rays = directions(70.0)[1:]
    expected = np.stack([theirs.img_from_cam(ray) for ray in rays]) - 0.5
    assert_projects(camera, expected, rays)


@pytest.mark.parametrize(
    ("source", "to", "bound"),
    [
        (AtanCamera([26.0, 25.8], [55.2, 47.1], 0.93, (96, 112), 1.3), "kannala_brandt", 0.02),
        (DivisionCamera([30.0, 29.7], [55.2, 47.1], [-0.22], (96, 112)), "kannala_brandt", 0.02),
        (
            KannalaBrandtCamera([24.0, 24.0], [55.2, 47.1], [-0.03, 0.0, 0.0, 0.0], (96, 112), 1.3),
            "division",
            0.1,
        ),
        (
            KannalaBrandtCamera([24.0, 24.0], [55.2, 47.1], [-0.06, 0.0, 0.0, 0.0], (96, 112), 0.9),
            "atan",
            0.5,
        ),
        (
            KannalaBrandtCamera([24.0, 24.0], [55.2, 47.1], [-0.03, 0.0, 0.0, 0.0], (96, 112), 1.5),
            "thin_prism_fisheye",
            1e-3,
        ),
    ],
)
def test_conversion_to_and_from_them(source: Camera, to: str, bound: float) -> None:
    assert convert(source, to=to).max_error < bound
