# SPDX-License-Identifier: Apache-2.0
"""The unified models against OpenCV in front, bisection past 90°, each other, and calibrations of real lenses."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import (
    Camera,
    ExtendedUnifiedCamera,
    PinholeCamera,
    UnifiedCamera,
    project_unified,
    unproject_unified,
)
from tests.cameras.calibration_samples import circle, double, published

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
# TUM-VI, the left lens at 512 x 512, as Basalt calibrated it.
TUM_FOCAL, TUM_CENTER = [191.14799836282189, 191.13150963902818], [254.9585771534443, 256.88154645599448]
TUM_ALPHA, TUM_BETA = 0.6291060881178562, 1.0418067381860868


def lens(
    xi: float, distortion: list[float] | None = None, size: tuple[int, int] = (4001, 4001)
) -> UnifiedCamera:
    tail = None if distortion is None else double(distortion)[0]
    return UnifiedCamera(*double(FOCAL, CENTER, xi), tail, size)


def extended(alpha: float = TUM_ALPHA, beta: float = TUM_BETA) -> ExtendedUnifiedCamera:
    return ExtendedUnifiedCamera(*double(TUM_FOCAL, TUM_CENTER, alpha, beta), (512, 512))


def kitti() -> UnifiedCamera:
    return UnifiedCamera(*double(KITTI_FOCAL, KITTI_CENTER, KITTI_XI, [*KITTI_DISTORTION, 0.0]), (1400, 1400))


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


@pytest.mark.parametrize("xi", [0.0, 0.4, 1.0, 2.5])
def test_with_beta_one_the_extended_is_the_unified_model(xi: float, generator: torch.Generator) -> None:
    """α = ξ / (1 + ξ), and f is γ / (1 + ξ)."""
    points = torch.randn(300, 3, generator=generator, dtype=torch.float64)
    focal, center = double(TUM_FOCAL, TUM_CENTER)
    unified = UnifiedCamera((1 + xi) * focal, center, double(xi)[0], None, (512, 512))
    camera = extended(xi / (1 + xi), 1.0)
    pixels, valid = camera.project(points)
    expected = unified.project(points)
    assert torch.equal(valid, expected.valid)
    torch.testing.assert_close(pixels[valid], expected.pixels[valid], rtol=0, atol=1e-10)
    assert camera.max_angle.item() == pytest.approx(unified.max_angle.item(), abs=1e-7)
    back, back_valid = camera.unproject(pixels)
    assert back_valid[valid].all()
    torch.testing.assert_close(
        back[valid], torch.nn.functional.normalize(points, dim=-1)[valid], rtol=0, atol=1e-12
    )


def mei_radius(angle: float) -> float:
    r = math.sin(angle) / (math.cos(angle) + KITTI_XI)
    return KITTI_FOCAL[0] * r * (1 + KITTI_DISTORTION[0] * r**2 + KITTI_DISTORTION[1] * r**4)


def extended_radius(angle: float) -> float:
    d = math.sqrt(TUM_BETA * math.sin(angle) ** 2 + math.cos(angle) ** 2)
    return TUM_FOCAL[0] * math.sin(angle) / (TUM_ALPHA * d + (1 - TUM_ALPHA) * math.cos(angle))


RADIAL = UnifiedCamera(
    *double([KITTI_FOCAL[0]] * 2, KITTI_CENTER, KITTI_XI, [*KITTI_DISTORTION[:2], 0, 0, 0]), (4001, 4001)
)


@pytest.mark.parametrize("degrees", [1e-5, 40.0, 89.99, 90.0, 97.0, 105.0, 110.0])
@pytest.mark.parametrize(("camera", "radius"), [(RADIAL, mei_radius), (extended(), extended_radius)])
def test_past_90_degrees_against_bisection(
    camera: UnifiedCamera | ExtendedUnifiedCamera, radius: Callable[[float], float], degrees: float
) -> None:
    """The pixel of an angle by the formula in plain Python, and the angle of that pixel by bisection."""
    angle, center = math.radians(degrees), camera.principal_point[0]
    pixels, valid = camera._project(circle(double(angle)[0], azimuth=0.0))
    assert valid
    assert (pixels[0] - center).item() == pytest.approx(radius(angle), abs=1e-9)
    low, high = 0.0, camera.max_angle.item()
    for _ in range(100):
        middle = (low + high) / 2
        low, high = (middle, high) if radius(middle) < pixels[0].item() - center else (low, middle)
    x, _, z = camera._unproject(pixels).directions.tolist()
    assert math.atan2(x, z) == pytest.approx(low, abs=1e-12)


@pytest.mark.parametrize("degrees", [1e-5, 40.0, 90.0, 110.0])
def test_a_real_lens_with_all_its_coefficients_there_and_back(degrees: float) -> None:
    point = circle(double(math.radians(degrees))[0], azimuth=0.0)
    pixels = kitti().project(point).pixels
    torch.testing.assert_close(kitti().unproject(pixels).directions, point, rtol=0, atol=1e-13)


def test_published_files_have_the_numbers_above() -> None:
    text = (published() / "kitti360_mei.yaml").read_text().split("image_03")[0]
    numbers = dict(re.findall(r"(xi|k1|k2|p1|p2|gamma1|gamma2|u0|v0): ([-+.e\d]+)", text))
    order = ["gamma1", "gamma2", "u0", "v0", "xi", "k1", "k2", "p1", "p2"]
    written = [*KITTI_FOCAL, *KITTI_CENTER, KITTI_XI, *KITTI_DISTORTION]
    assert [float(numbers[name]) for name in order] == written
    first = json.loads((published() / "tumvi_512_basalt_eucm.json").read_text())["value0"]["intrinsics"][0]
    names = ["fx", "fy", "cx", "cy", "alpha", "beta"]
    written = [*TUM_FOCAL, *TUM_CENTER, TUM_ALPHA, TUM_BETA]
    assert [first["intrinsics"][name] for name in names] == written


def below(angle: Tensor, alpha: float, beta: float) -> Tensor:
    return alpha * torch.sqrt(beta * angle.sin() ** 2 + angle.cos() ** 2) + (1 - alpha) * angle.cos()


@pytest.mark.parametrize(
    ("camera", "denominator"),
    [
        *((lens(xi), lambda a, xi=xi: a.cos() + xi) for xi in (-0.4, 0.0, 0.5, 1.0, 1.01, 2.2)),
        *(
            (extended(alpha, beta), lambda a, alpha=alpha, beta=beta: below(a, alpha, beta))
            for alpha, beta in ((0.3, 1.4), (0.5, 0.8), (0.63, 1.04), (0.8, 2.0), (1.0, 0.5))
        ),
    ],
)
def test_ends_exactly_where_the_radius_stops_growing(
    camera: Camera, denominator: Callable[[Tensor], Tensor]
) -> None:
    """Found by scanning the formula: up to its pole, or its maximum."""
    angle = torch.linspace(0, math.pi, 20001, dtype=torch.float64)[1:-1]
    radius = angle.sin() / denominator(angle)
    growing = (radius.diff(prepend=radius.new_zeros(1)) > 0) & (denominator(angle) > 0)
    seen = growing.long().cumprod(0).bool()
    assert (camera._project(circle(angle) * 3.0).valid != seen).sum() <= 1
    assert camera.max_angle.item() == pytest.approx(angle[seen].max().item(), abs=2e-4)


def test_zero_and_one_are_known_projections(generator: torch.Generator) -> None:
    points = torch.randn(100, 3, generator=generator, dtype=torch.float64)
    pinhole = PinholeCamera(*double(FOCAL, CENTER), (4001, 4001)).project(points)
    pixels, valid = lens(0.0).project(points)
    assert torch.equal(valid, pinhole.valid)
    torch.testing.assert_close(pixels[valid], pinhole.pixels[valid], rtol=0, atol=1e-8)
    tangent = torch.tan(torch.atan2(points[:, :2].norm(dim=-1), points[:, 2]) / 2)  # stereographic
    radius = ((lens(1.0).project(points).pixels - double(CENTER)[0]) / double(FOCAL)[0]).norm(dim=-1)
    torch.testing.assert_close(radius, tangent)


@pytest.mark.parametrize(("camera", "end"), [(lens(2.0), 1 / math.sqrt(3)), (extended(0.75, 2.0), 1.0)])
def test_pixels_beyond_the_model_are_reported(
    camera: UnifiedCamera | ExtendedUnifiedCamera, end: float
) -> None:
    """The image ends at the radius 1 / √(ξ² − 1) for ξ > 1, at 1 / √(β (2α − 1)) for α > 1/2."""
    radius = torch.tensor([0.999, 1.001, 30.0], dtype=torch.float64) * end
    along = camera.focal_length * torch.tensor([1.0, 0.0], dtype=torch.float64)
    directions, valid = camera._unproject(camera.principal_point + radius.unsqueeze(-1) * along)
    assert valid.tolist() == [True, False, False]
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(3, dtype=torch.float64))


def test_distortion_that_folds_ends_the_image() -> None:
    folding = lens(1.0, [-1 / 3, 0.0, 0.0, 0.0])  # folds at 2 tan(θ/2)/2 = 1: 90°
    assert folding.max_angle.item() == pytest.approx(math.pi / 2, abs=1e-3)
    points = circle(torch.tensor([1.56, 1.58], dtype=torch.float64))
    assert project_unified(points, *folding._aligned(points)[:4]).valid.tolist() == [True, False]
