# SPDX-License-Identifier: Apache-2.0
"""The unified model and Mei's against OpenCV in front, bisection past 90°, and a real car's calibration."""

from __future__ import annotations

import math
import os
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import PinholeCamera, UnifiedCamera, project_unified, unproject_unified

FOCAL, CENTER = [400.0, 405.0], [320.5, 310.0]
DISTORTION = [-0.1, 0.02, 1e-3, -7e-4]
MATRIX = np.array([[FOCAL[0], 0, CENTER[0]], [0, FOCAL[1], CENTER[1]], [0, 0, 1]])
# KITTI-360, image_02: a lens of 185°.
KITTI_XI = 2.2134047507854890
KITTI_DISTORTION = [
    1.6798235660113681e-02,
    1.6548773243373522,
    4.2223943394772046e-04,
    4.2462134260997584e-04,
]
KITTI_FOCAL, KITTI_CENTER = [1336.3220825849971, 1335.7883350012958], [716.94323510126321, 705.76498308221585]


def published(name: str) -> Path:
    """A calibration that others publish; it is not part of this package."""
    default = Path(__file__).resolve().parents[2].parent / "shared" / "real"
    path = Path(os.environ.get("SPHERICALVISION_REAL", default)) / "calibrations" / name
    if not path.is_file():
        pytest.skip("published calibrations not found; set SPHERICALVISION_REAL to the folder that has them")
    return path


def double(*values: float | list[float]) -> list[Tensor]:
    return [torch.tensor(value, dtype=torch.float64) for value in values]


def lens(
    xi: float, distortion: list[float] | None = None, size: tuple[int, int] = (4001, 4001)
) -> UnifiedCamera:
    tail = None if distortion is None else double(distortion)[0]
    return UnifiedCamera(*double(FOCAL, CENTER, xi), tail, size)


def kitti() -> UnifiedCamera:
    return UnifiedCamera(*double(KITTI_FOCAL, KITTI_CENTER, KITTI_XI, [*KITTI_DISTORTION, 0.0]), (1400, 1400))


def circle(angle: Tensor, azimuth: float = 0.7) -> Tensor:
    """Unit vectors (*, 3) at angles (*) from the axis."""
    flat = angle.sin()
    return torch.stack((flat * math.cos(azimuth), flat * math.sin(azimuth), angle.cos()), -1)


@pytest.mark.parametrize("xi", [0.3, 1.0, KITTI_XI])
@pytest.mark.parametrize("distortion", [None, DISTORTION])
def test_against_opencv_in_front(
    xi: float, distortion: list[float] | None, generator: torch.Generator
) -> None:
    points = torch.randn(200, 3, generator=generator, dtype=torch.float64) + double([0.0, 0.0, 3.0])[0]
    points = points[points[:, 2] > 0.5]
    zero, given = np.zeros((3, 1)), np.array(distortion or [0.0] * 4)
    expected, _ = cv2.omnidir.projectPoints(points.numpy()[:, None], zero, zero, MATRIX, xi, given)
    camera = lens(xi, distortion)
    np.testing.assert_allclose(camera.project(points).pixels, expected[:, 0], rtol=0, atol=1e-9)
    directions, valid = unproject_unified(*(torch.from_numpy(expected[:, 0]), *camera._aligned(points)[:4]))
    assert valid.all()
    undistorted = cv2.omnidir.undistortPoints(expected, MATRIX, given, np.array([xi]), np.eye(3))[:, 0]
    np.testing.assert_allclose(directions[:, :2] / directions[:, 2:], undistorted, rtol=0, atol=1e-5)
    torch.testing.assert_close(directions, torch.nn.functional.normalize(points, dim=-1), rtol=0, atol=1e-13)


@pytest.mark.parametrize("degrees", [1e-5, 40.0, 89.99, 90.0, 100.0, 110.0])
def test_past_90_degrees_against_bisection(degrees: float) -> None:
    """The pixel of an angle by Mei's formulas in plain Python, and the angle of that pixel by bisection."""

    def radius(angle: float) -> float:
        r = math.sin(angle) / (math.cos(angle) + KITTI_XI)
        return KITTI_FOCAL[0] * r * (1 + KITTI_DISTORTION[0] * r**2 + KITTI_DISTORTION[1] * r**4)

    radial = UnifiedCamera(
        *double([KITTI_FOCAL[0]] * 2, KITTI_CENTER, KITTI_XI, [*KITTI_DISTORTION[:2], 0, 0, 0]), (4001, 4001)
    )
    angle = math.radians(degrees)
    point = circle(double(angle)[0], azimuth=0.0)
    pixels, valid = radial.project(point)
    assert valid
    assert (pixels[0] - KITTI_CENTER[0]).item() == pytest.approx(radius(angle), abs=1e-9)
    low, high = 0.0, math.acos(-1 / KITTI_XI)
    for _ in range(100):
        middle = (low + high) / 2
        low, high = (middle, high) if radius(middle) < pixels[0].item() - KITTI_CENTER[0] else (low, middle)
    x, _, z = radial.unproject(pixels).directions.tolist()
    assert math.atan2(x, z) == pytest.approx(low, abs=1e-12)
    full = kitti().project(point).pixels
    torch.testing.assert_close(kitti().unproject(full).directions, point, rtol=0, atol=1e-13)


def test_kitti_360_file() -> None:
    """The numbers above are those of the file."""
    text = published("kitti360_mei.yaml").read_text().split("image_03")[0]
    numbers = dict(re.findall(r"(xi|k1|k2|p1|p2|gamma1|gamma2|u0|v0): ([-+.e\d]+)", text))
    order = ["gamma1", "gamma2", "u0", "v0", "xi", "k1", "k2", "p1", "p2"]
    written = [*KITTI_FOCAL, *KITTI_CENTER, KITTI_XI, *KITTI_DISTORTION]
    assert [float(numbers[name]) for name in order] == written


@pytest.mark.parametrize("xi", [-0.4, 0.0, 0.5, 1.0, 1.01, 2.2])
def test_ends_exactly_where_the_radius_stops_growing(xi: float) -> None:
    """Found by scanning sin θ / (cos θ + ξ) itself: up to its pole, or its maximum."""
    angle = torch.linspace(0, math.pi, 20001, dtype=torch.float64)[1:-1]
    radius = angle.sin() / (angle.cos() + xi)
    growing = (radius.diff(prepend=radius.new_zeros(1)) > 0) & (angle.cos() + xi > 0)
    points = circle(angle) * 3.0
    camera = lens(xi)
    valid = project_unified(points, *camera._aligned(points)[:4]).valid
    assert (valid != growing.long().cumprod(0).bool()).sum() <= 1
    assert camera.max_angle.item() == pytest.approx(angle[growing].max().item(), abs=2e-4)


def test_zero_and_one_are_known_projections(generator: torch.Generator) -> None:
    points = torch.randn(100, 3, generator=generator, dtype=torch.float64)
    pinhole = PinholeCamera(*double(FOCAL, CENTER), (4001, 4001)).project(points)
    pixels, valid = lens(0.0).project(points)
    assert torch.equal(valid, pinhole.valid)
    torch.testing.assert_close(pixels[valid], pinhole.pixels[valid], rtol=0, atol=1e-8)
    tangent = torch.tan(torch.atan2(points[:, :2].norm(dim=-1), points[:, 2]) / 2)  # stereographic
    radius = ((lens(1.0).project(points).pixels - double(CENTER)[0]) / double(FOCAL)[0]).norm(dim=-1)
    torch.testing.assert_close(radius, tangent)


def test_pixels_beyond_the_model_are_reported() -> None:
    """For ξ > 1 the image ends at the radius 1 / √(ξ² − 1)."""
    camera = lens(2.0)
    radius = torch.tensor([0.999, 1.001, 30.0], dtype=torch.float64) / math.sqrt(3)
    pixels = double(CENTER)[0] + radius.unsqueeze(-1) * double([FOCAL[0], 0.0])[0]
    directions, valid = unproject_unified(pixels, *camera._aligned(pixels)[:4])
    assert valid.tolist() == [True, False, False]
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(3, dtype=torch.float64))
    folding = lens(1.0, [-1 / 3, 0.0, 0.0, 0.0])  # folds at 2 tan(θ/2)/2 = 1: 90°
    assert folding.max_angle.item() == pytest.approx(math.pi / 2, abs=1e-3)
    points = circle(torch.tensor([1.56, 1.58], dtype=torch.float64))
    assert project_unified(points, *folding._aligned(points)[:4]).valid.tolist() == [True, False]


def test_impossible_intrinsics_are_refused() -> None:
    with pytest.raises(ValueError, match=r"xi: expected numbers above -1, got -1.0"):
        lens(-1.0)
    with pytest.raises(ValueError, match=r"distortion: expected \(\*, 5\) .* got shape \(3,\)"):
        lens(1.0, [0.0] * 3)
