# SPDX-License-Identifier: Apache-2.0
"""Iterative inverses converge for real calibrations and for any plausible one, up to where their lens ends."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from sphericalvision.cameras import (
    KannalaBrandtCamera,
    project_kannala_brandt,
    project_ocam,
    unproject_kannala_brandt,
    unproject_ocam,
)
from tests.cameras.test_calibrations_of_one_lens import KB4
from tests.laws.camera_laws import circle

# Of public data sets: TUM-VI's two cameras, the Intel T265's two, as Kalibr and Basalt give them.
REAL_KANNALA_BRANDT = {
    "tum-vi 0": (190.978, KB4["distortion"][0]),
    "tum-vi 1": (190.442, KB4["distortion"][1]),
    "t265 0": (
        286.601,
        [-0.006762412326815424, 0.045170283325720008, -0.043515167278210638, 0.008374959821591333],
    ),
    "t265 1": (
        286.949,
        [-0.00917659267037002, 0.05074013237676034, -0.04804389088255095, 0.009643678532407408],
    ),
}
# A fisheye lens of 220° on 1600 x 1600 pixels and a mirror before 1024 x 768.
REAL_OCAM = {
    "fisheye": (1120.0, [-4.714441e02, 0.0, 7.356108e-04, -3.773045e-07, 5.800006e-10]),
    "mirror": (640.0, [-1.314797e02, 0.0, 1.848991e-03, 2.251206e-07, -7.343233e-10]),
}


def double(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


CENTER, PLAIN = double(500.0, 400.0), double(1.0, 0.0, 0.0)


def widest_angle(distortion: list[float], slope: float = 0.0) -> float:
    """Where the radius stops growing, or grows by less than ``slope``; π if nowhere."""
    roots = np.roots([*reversed([(2 * i + 3) * k for i, k in enumerate(distortion)]), 1.0 - slope])
    squares = [root.real for root in roots if abs(root.imag) < 1e-9 and root.real > 0]
    return min([math.sqrt(square) for square in squares] + [math.pi])


def on_a_spiral(radius: Tensor) -> Tensor:
    """(x, y) of these distances from the centre."""
    azimuth = 2.4 * torch.arange(len(radius), dtype=torch.float64)
    return torch.stack((radius * azimuth.cos(), radius * azimuth.sin()), -1)


def check_kannala_brandt(focal_length: float, distortion: list[float], until: float) -> None:
    """From pixels by definition to directions, whose angles must be those that made them."""
    angle = torch.cat((torch.logspace(-6, -1, 11), torch.linspace(0.1, 1, 120) * until)).double()
    angle = angle[angle <= until]
    radius = angle * (1 + sum(k * angle ** (2 * i + 2) for i, k in enumerate(distortion)))
    lens = (double(focal_length, focal_length), CENTER, double(*distortion))
    pixels = on_a_spiral(focal_length * radius) + CENTER
    directions, valid = unproject_kannala_brandt(pixels, *lens)
    again, again_valid = project_kannala_brandt(directions, *lens)
    assert valid.all()
    assert again_valid.all()
    assert (again - pixels).norm(dim=-1).max() <= 1e-10 * max(1.0, float(radius.max()))
    single, single_valid = unproject_kannala_brandt(pixels.float(), *(tensor.float() for tensor in lens))
    back = project_kannala_brandt(single, *(tensor.float() for tensor in lens)).pixels
    inside = angle < 0.995 * until
    assert single_valid[inside].all()
    assert (back - pixels).norm(dim=-1)[inside].max() <= 1e-3 * max(1.0, float(radius.max()))


@pytest.mark.parametrize("name", REAL_KANNALA_BRANDT)
def test_real_kannala_brandt(name: str) -> None:
    focal_length, distortion = REAL_KANNALA_BRANDT[name]
    check_kannala_brandt(focal_length, distortion, 0.9995 * widest_angle(distortion))


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    st.tuples(
        *(st.integers(-100, 100).map(lambda n, most=most: n / 100 * most) for most in (0.3, 0.15, 0.06, 0.02))
    ),
    st.floats(100, 900),
)
def test_plausible_kannala_brandt(distortion: tuple[float, ...], focal_length: float) -> None:
    """Far from every lens that was ever ground, too; up to where its image shrinks to four tenths of the middle's."""
    check_kannala_brandt(focal_length, list(distortion), 0.999 * widest_angle(list(distortion), 0.4))


def growing_until(direct: list[float], most: float) -> float:
    """The image radius up to which the angle grows: where ρ f'(ρ) − f(ρ) has its first root."""
    f = np.polynomial.Polynomial(direct)
    slope = np.polynomial.Polynomial([0, 1]) * f.deriv() - f
    roots = [root.real for root in slope.roots() if abs(root.imag) < 1e-9 and root.real > 0]
    return min([*roots, most])


def check_ocam(direct: list[float], most: float, share: float) -> None:
    """From pixels by definition to pixels again."""
    radius = torch.linspace(0, 1, 120).double().square() * share * growing_until(direct, most)
    polynomial = double(*direct)
    pixels = on_a_spiral(radius) + CENTER
    height = -sum(a * radius**power for power, a in enumerate(direct))
    points = torch.cat((pixels - CENTER, height.unsqueeze(-1)), -1)
    again, valid = project_ocam(points, polynomial, None, CENTER, PLAIN, most)
    assert valid.all()
    assert (again - pixels).norm(dim=-1).max() <= 1e-9
    directions = unproject_ocam(pixels, polynomial, CENTER, PLAIN).directions
    again = project_ocam(directions, polynomial, None, CENTER, PLAIN, most).pixels
    assert (again - pixels).norm(dim=-1).max() <= 1e-9


@pytest.mark.parametrize("name", REAL_OCAM)
def test_real_ocam(name: str) -> None:
    most, direct = REAL_OCAM[name]
    check_ocam(direct, most, 0.9995)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.floats(80, 600), *(st.integers(-100, 100) for _ in range(3)))
def test_plausible_ocam(focal_length: float, second: int, third: int, fourth: int) -> None:
    """Coefficients such that every power counts at the border of the image."""
    most = 2.2 * focal_length
    direct = [-focal_length, 0.0]
    direct += [
        percent / 100 * focal_length / most**power
        for power, percent in ((2, second), (3, third), (4, fourth))
    ]
    check_ocam(direct, most, 0.995)


def test_a_lens_is_followed_up_to_its_turning_point() -> None:
    """θ − θ³/3 turns at 1 rad: just before it the inverse is steep without end, and still found."""
    distortion, focal_length, center = double(-1 / 3, 0.0, 0.0, 0.0), double(200.0, 200.0), double(0.0, 0.0)
    angle = 1 - torch.logspace(-1, -4, 9).double()
    pixels = torch.stack((200 * (angle - angle**3 / 3), torch.zeros(9).double()), -1)
    directions, valid = unproject_kannala_brandt(pixels, focal_length, center, distortion)
    assert valid.all()
    found = torch.atan2(directions[:, 0], directions[:, 2])
    assert ((found - angle).abs() <= 1e-14 / (1 - angle) + 1e-15).all()  # as well as the pixel tells
    beyond = double(200 * 2 / 3 + 1e-6, 0.0)
    assert not unproject_kannala_brandt(beyond, focal_length, center, distortion).valid
    camera = KannalaBrandtCamera(focal_length, center, distortion, (9, 9))
    assert camera.max_angle.item() == pytest.approx(1.0, abs=1e-7)
    around = circle(double(1 - 1e-6, 1 + 1e-6))
    valid = project_kannala_brandt(around, focal_length, center, distortion).valid
    assert valid.tolist() == [True, False]
