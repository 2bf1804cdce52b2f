# SPDX-License-Identifier: Apache-2.0
"""The OCam model, against bisection in float64 and against the model's definition written out."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from sphericalvision.cameras import FisheyeCamera, OCamCamera, project_ocam

DIRECT = [-392.2, 0.0, 1.2707e-3, -1.7456e-6, 2.2576e-9]  # like a real 220° lens on 1532 x 1600 pixels
CENTER = [811.661, 756.215]
AFFINE = [0.999876, -2.91382e-2, 1.66556e-2]
SIZE = (1532, 1600)
WIDE = math.radians(110)


def camera(inverse: list[float] | None = None, dtype: torch.dtype = torch.float64) -> OCamCamera:
    tensors = [torch.tensor(values, dtype=dtype) for values in (DIRECT, CENTER, AFFINE)]
    return OCamCamera(tensors[0], inverse, tensors[1], tensors[2], SIZE, WIDE)


def by_definition(point: np.ndarray, direct: list[float]) -> tuple[float, float]:
    """(row, col) by bisection on the image radius: the ray (rho·x/r, rho·y/r, −f(rho)) must point to the point."""
    x, y, z = point
    r = math.hypot(x, y)
    wanted = math.atan2(r, z)
    low, high = 0.0, 1400.0
    for _ in range(200):
        rho = (low + high) / 2
        f = sum(a * rho**k for k, a in enumerate(direct))
        low, high = (rho, high) if math.atan2(rho, -f) < wanted else (low, rho)
    row, col = rho * y / r, rho * x / r
    c, d, e = AFFINE
    return c * row + d * col + CENTER[1], e * row + col + CENTER[0]


@pytest.mark.parametrize("direct", [DIRECT, [-300.0, 0.0, 8e-4], [-300.0, 0.0, 8e-4, 0, 1e-10, 0, 1e-18]])
def test_exact_inverse_against_bisection(direct: list[float], generator: torch.Generator) -> None:
    """Of any degree."""
    lens = OCamCamera(torch.tensor(direct, dtype=torch.float64), None, CENTER, AFFINE, SIZE, WIDE)
    angle = torch.rand(60, generator=generator, dtype=torch.float64) * 1.9
    azimuth = torch.rand(60, generator=generator, dtype=torch.float64) * 2 * math.pi
    points = torch.stack((angle.sin() * azimuth.cos(), angle.sin() * azimuth.sin(), angle.cos()), -1) * 3
    u, v = lens.project(points).pixels.unbind(-1)
    rows, columns = np.array([by_definition(point, direct) for point in points.numpy()]).T
    np.testing.assert_allclose(v, rows, atol=1e-7)
    np.testing.assert_allclose(u, columns, atol=1e-7)


@pytest.mark.parametrize("scale", [1e-12, 1e-8, 1e-5, 1e-3, 1e-2])
def test_exact_inverse_is_precise_next_to_the_axis_in_float32(scale: float) -> None:
    """There an image radius is the angle times the focal length −a0."""
    lens = OCamCamera(DIRECT, None, [0.0, 0.0], [1.0, 0.0, 0.0], SIZE, WIDE)
    pixel = lens.project(torch.tensor([scale, 0.0, 1.0])).pixels
    assert pixel[0].item() == pytest.approx(392.2 * scale, rel=1e-4)


def test_convention_ocam_center_is_row_column_in_files(tmp_path: pytest.TempPathFactory) -> None:
    from sphericalvision.cameras import read_camera

    lines = [
        "3 -100 0 0.002",
        "2 157 100",
        "12.5 20.25",
        "1 0 0",
        "30 40",
    ]  # row 12.5, column 20.25; height 30, width 40
    path = tmp_path / "ocam.txt"
    path.write_text("\n\n".join(lines))
    lens = read_camera(path)
    assert lens.principal_point.tolist() == [20.25, 12.5]
    assert lens.image_size == (30, 40)
    right_and_a_little_down = (
        lens.exact().project(torch.tensor([0.1, 0.01, 1.0])).pixels - lens.principal_point
    )
    assert right_and_a_little_down[0] > right_and_a_little_down[1] > 0


def test_inverse_polynomial_is_used_as_files_define_it() -> None:
    """rho is a polynomial of atan2(−z, hypot(x, y)); affine as row = c·row' + d·col', col = e·row' + col'."""
    inverse = [600.0, 390.0, -15.0, -60.0]
    point = np.array([0.3, -0.7, -0.1])
    hypot = math.hypot(point[0], point[1])
    theta = math.atan2(-point[2], hypot)
    rho = sum(b * theta**k for k, b in enumerate(inverse))
    row, col = rho * point[1] / hypot, rho * point[0] / hypot
    c, d, e = AFFINE
    expected = [e * row + col + CENTER[0], c * row + d * col + CENTER[1]]
    pixels = camera(inverse).project(torch.tensor(point)).pixels
    np.testing.assert_allclose(pixels, expected, atol=1e-9)


def test_function_equals_the_camera() -> None:
    lens = camera()
    points = torch.tensor([[0.3, 0.2, 0.5], [1.0, 0.0, -0.2]], dtype=torch.float64)
    pixels = project_ocam(points, lens.polynomial, None, lens.principal_point, lens.affine, 1400.0).pixels
    torch.testing.assert_close(pixels, lens.project(points).pixels)


def test_stereographic_lens_is_an_ocam_of_degree_two() -> None:
    """rho = 2 f tan(angle/2) is the polynomial −f + rho²/(4 f)."""
    focal = 300.0
    ocam = OCamCamera([-focal, 0.0, 1 / (4 * focal)], None, CENTER, [1.0, 0.0, 0.0], SIZE, WIDE).to(
        torch.float64
    )
    fisheye = FisheyeCamera("stereographic", torch.tensor(focal).double(), ocam.principal_point, SIZE, WIDE)
    pixels = fisheye.pixel_grid()[::40, ::40]
    directions, valid = fisheye.unproject(pixels)
    torch.testing.assert_close(ocam.unproject(pixels).directions, directions, rtol=0, atol=1e-6)
    torch.testing.assert_close(ocam.project(directions).pixels[valid], pixels[valid], rtol=0, atol=1e-4)


def test_directions_outside_the_polynomials_range_are_not_valid() -> None:
    """This polynomial bends back: radii beyond 200 px look at smaller angles again."""
    lens = OCamCamera([-100.0, 0.0, -2.5e-3], None, [500.0, 500.0], [1.0, 0.0, 0.0], (1001, 1001), math.pi)
    pixels = torch.tensor([[500.0 + radius, 500.0] for radius in (0.0, 150.0, 199.0, 201.0, 400.0)])
    assert lens.unproject(pixels).valid.tolist() == [True, True, True, False, False]
    assert not lens.project(torch.tensor([1.0, 0.0, 0.0])).valid


@pytest.mark.parametrize(
    "affine", [[1.0, 0.0, 0.0], [0.5, 0.0, 0.0], [2.0, 0.0, 0.0], [1.0, 0.3, 0.3], [0.7, 0.4, 0.1]]
)
def test_without_max_angle_it_ends_where_its_image_or_its_polynomial_does(affine: list[float]) -> None:
    polynomial = torch.tensor([-100.0, 0.0, 0.0025], dtype=torch.float64)
    lens = OCamCamera(polynomial, None, [319.5, 239.5], affine, (480, 640))
    pixels = torch.tensor([[-0.4, -0.4], [639.4, -0.4], [-0.4, 479.4], [639.4, 479.4]], dtype=torch.float64)
    corners = lens.unproject(pixels)
    assert corners.valid.all()
    back = lens.project(corners.directions)
    assert back.valid.all()
    torch.testing.assert_close(back.pixels, pixels)
    polynomial[2] = -0.04  # tan θ = ρ / (100 + 0.04 ρ²) is largest at ρ = 50
    folding = OCamCamera(polynomial, None, [319.5, 239.5], [1.0, 0.0, 0.0], (480, 640))
    assert float(folding.max_angle) == pytest.approx(math.atan(50 / 200), abs=1e-6)
