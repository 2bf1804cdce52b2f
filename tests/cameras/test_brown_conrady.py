# SPDX-License-Identifier: Apache-2.0
"""Where the distortion of the Brown-Conrady model folds: by finite differences of OpenCV's pixels, and up to there."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import BrownConradyCamera, project_brown_conrady, unproject_brown_conrady
from tests.cameras.calibration_samples import KINECT, matrix, opencv_plain
from tests.laws.camera_laws import circle

FOCAL, CENTER, SIZE = [500.0, 510.0], [320.0, 240.0], (481, 641)
MATRIX = matrix(*FOCAL, *CENTER)


def lens(distortion: list[float], size: tuple[int, int] = SIZE) -> BrownConradyCamera:
    tensors = (torch.tensor(values, dtype=torch.float64) for values in (FOCAL, CENTER, distortion))
    return BrownConradyCamera(*tensors, size)


@pytest.mark.parametrize("tangential", [0.0, 0.01])
def test_ends_where_the_determinant_vanishes(tangential: float) -> None:
    """By finite differences of OpenCV's pixels along rays from the centre: the first sign change is the end."""
    distortion = [-0.3, 0.0, tangential, -tangential / 2]
    camera = lens(distortion, (4001, 4001))
    step = 1e-6
    for azimuth in np.linspace(0, 2 * np.pi, 7):
        # Up to the radius 1.83 at which the lens sees straight ahead again
        radius = np.linspace(0.9, 1.7, 81)
        plane = torch.tensor(np.stack((radius * np.cos(azimuth), radius * np.sin(azimuth)), -1))
        shifts = torch.tensor([[step, 0.0], [-step, 0.0], [0.0, step], [0.0, -step]], dtype=torch.float64)
        places = torch.nn.functional.pad((plane[:, None] + shifts).reshape(-1, 2), (0, 1), value=1.0)
        moved = opencv_plain(places.numpy(), MATRIX, distortion).reshape(-1, 4, 2)
        along_x, along_y = moved[:, 0] - moved[:, 1], moved[:, 2] - moved[:, 3]
        positive = along_x[:, 0] * along_y[:, 1] - along_x[:, 1] * along_y[:, 0] > 0
        first = np.cumprod(positive).astype(bool)
        points = torch.nn.functional.pad(plane, (0, 1), value=1.0)
        _, valid = project_brown_conrady(points, *camera._aligned(points)[:3])
        np.testing.assert_array_equal(valid, first)


@pytest.mark.parametrize("distortion", [[-1 / 3, 0.0, 1e-3, 0.0], [-0.28, 0.03, 0.01, -0.005]])
def test_what_is_seen_is_looked_at_up_to_the_fold(distortion: list[float]) -> None:
    """Of 20000 directions, also where strong tangential distortion makes the radial start a bad one."""
    camera = lens(distortion, (4001, 4001))
    generator = torch.Generator().manual_seed(0)
    angle = torch.rand(20000, generator=generator, dtype=torch.float64) * camera.max_angle
    points = circle(angle, torch.arange(20000, dtype=torch.float64))
    pixels, seen = project_brown_conrady(points, *camera._aligned(points)[:3])
    directions, found = unproject_brown_conrady(pixels, *camera._aligned(pixels)[:3])
    assert not (seen & ~found).any()
    error = (directions - points).norm(dim=-1)[seen & found]
    assert error.max() < 1e-10  # at the fold the inverse has an infinite slope
    assert error.quantile(0.99) < 1e-13


@pytest.mark.parametrize("distortion", [[-0.28, 0.07, 2e-4, -3e-4, -0.01], [-1 / 3, 0, 0, 0]])
def test_flags_hold_up_to_a_millionth_from_the_fold(distortion: list[float]) -> None:
    """The inverse has a double root there, and Newton's method halves its error only."""
    intrinsics = [torch.tensor(values, dtype=torch.float64) for values in (FOCAL, CENTER, distortion)]

    def at(angle: float) -> Tensor:
        return torch.tensor([math.sin(angle), 0.0, math.cos(angle)], dtype=torch.float64)

    seen, fold = 0.0, 1.5
    for _ in range(60):
        middle = (seen + fold) / 2
        if project_brown_conrady(at(middle), *intrinsics).valid:
            seen = middle
        else:
            fold = middle
    assert 0.5 < fold < 1.4
    rays = torch.stack([at(fold - distance) for distance in (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)])
    directions, valid = unproject_brown_conrady(project_brown_conrady(rays, *intrinsics).pixels, *intrinsics)
    assert valid.all()
    torch.testing.assert_close(directions, rays, rtol=0, atol=1e-9)


def test_behind_and_beside_the_camera_is_not_valid_and_finite() -> None:
    points = torch.tensor(
        [[0.1, 0.2, -1.0], [1.0, 0.0, 0.0], [1.0, 0.0, 1e-30], [1e3, 0.0, 1e-2], [0.0, 0.0, 0.0]]
    )
    for dtype in (torch.float32, torch.float64):
        camera = lens(KINECT).to(dtype)
        pixels, valid = camera.project(points.to(dtype))
        assert not valid.any()
        assert pixels.isfinite().all()
