# SPDX-License-Identifier: Apache-2.0
"""The radial polynomial model against its definition, bisection past 90°, and the lens that it can imitate."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from sphericalvision.cameras import (
    KannalaBrandtCamera,
    RadialPolynomialCamera,
    project_radial_polynomial,
    unproject_radial_polynomial,
)
from tests.cameras.calibration_samples import circle, double

# Of the size of WoodScape's front camera: 1280 x 966, about 190°.
POLYNOMIAL, CENTER, ASPECT, SIZE = [339.7, -32.0, 48.3, -7.2], [643.4, 479.1], 1.1, (966, 1280)


def lens(polynomial: list[float] = POLYNOMIAL, aspect: float = ASPECT) -> RadialPolynomialCamera:
    return RadialPolynomialCamera(*double(polynomial, CENTER, aspect), SIZE)


def radius(angle: float, polynomial: list[float] = POLYNOMIAL) -> float:
    return sum(k * angle ** (power + 1) for power, k in enumerate(polynomial))


@pytest.mark.parametrize("degrees", [1e-5, 0.1, 45.0, 89.0, 90.0, 91.0, 110.0, 150.0])
def test_against_the_definition_and_bisection(degrees: float) -> None:
    angle, camera = math.radians(degrees), lens()
    point = circle(double(angle)[0])
    pixels, _ = camera.project(7.0 * point)
    expected = [CENTER[0] + radius(angle) * math.cos(0.7), CENTER[1] + ASPECT * radius(angle) * math.sin(0.7)]
    np.testing.assert_allclose(pixels, expected, rtol=0, atol=1e-10)
    u, v = (pixels - double(CENTER)[0]).tolist()
    low, high = 0.0, math.pi
    for _ in range(100):
        middle = (low + high) / 2
        low, high = (middle, high) if radius(middle) < math.hypot(u, v / ASPECT) else (low, middle)
    directions, valid = unproject_radial_polynomial(pixels, *camera._aligned(pixels))
    assert valid
    torch.testing.assert_close(directions, circle(double(low)[0]), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    "polynomial", [[300.0], [300.0, -40.0], [300.0, 0, -9.0, 0, 0.4], [250.0, 90, 0, 0, 0, -0.6]]
)
def test_any_degree_there_and_back(polynomial: list[float]) -> None:
    camera = lens(polynomial, 0.9)
    angle = torch.cat(
        (torch.logspace(-6, -1, 20), torch.linspace(0.1, 0.995, 40) * camera.max_angle)
    ).double()
    points = circle(angle, 2.5)
    pixels = project_radial_polynomial(points, *camera._aligned(points))
    back = unproject_radial_polynomial(pixels.pixels, *camera._aligned(points))
    assert pixels.valid.all()
    assert back.valid.all()
    torch.testing.assert_close(back.directions, points, rtol=0, atol=1e-12)
    for value, pixel in zip(angle.tolist(), pixels.pixels, strict=True):
        assert pixel[0].item() == pytest.approx(
            CENTER[0] + radius(value, polynomial) * math.cos(2.5), abs=1e-9
        )


def test_odd_powers_are_kannala_brandt(generator: torch.Generator) -> None:
    """As in the radial part of Project Aria's lenses: focal length times θ + k1 θ³ + k2 θ⁵ + ..."""
    k = [0.01, -0.004, 0.002, -0.0003]
    odd = [240.0, 0, 240 * k[0], 0, 240 * k[1], 0, 240 * k[2], 0, 240 * k[3]]
    other = KannalaBrandtCamera(*double([240.0, 240.0], CENTER, k), SIZE, math.radians(105))
    camera = lens(odd, 1.0).with_max_angle(math.radians(105))
    points = torch.randn(200, 3, generator=generator, dtype=torch.float64)
    pixels, valid = camera.project(points)
    expected = other.project(points)
    assert torch.equal(valid, expected.valid)
    torch.testing.assert_close(pixels[valid], expected.pixels[valid], rtol=0, atol=1e-9)


def test_ends_where_the_radius_stops_growing() -> None:
    """300 θ − 100 θ² grows up to θ = 1.5 and the radius 225."""
    camera = lens([300.0, -100.0], 1.0)
    assert camera.max_angle.item() == pytest.approx(1.5, abs=1e-6)
    points = circle(torch.tensor([1.49, 1.51, 2.9], dtype=torch.float64), 0.0)
    assert project_radial_polynomial(points, *camera._aligned(points)).valid.tolist() == [True, False, False]
    pixels = double(CENTER)[0] + torch.tensor([[224.9, 0.0], [225.1, 0.0], [1e4, 0.0]], dtype=torch.float64)
    directions, valid = unproject_radial_polynomial(pixels, *camera._aligned(pixels))
    assert valid.tolist() == [True, False, False]
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(3, dtype=torch.float64))
