# SPDX-License-Identifier: Apache-2.0
"""What the laws cannot know: each model against OpenCV, its formula, or numbers worked out by hand."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
import torch

from sphericalvision.cameras import (
    DoubleSphereCamera,
    EquirectangularCamera,
    FisheyeCamera,
    KannalaBrandtCamera,
    PinholeCamera,
    points_from_depth,
    project_fisheye,
    project_kannala_brandt,
    unproject_kannala_brandt,
)
from sphericalvision.core import ArgumentError
from tests.cameras.calibration_samples import double

FOCAL, CENTER, SIZE = [190.97, 188.3], [254.93, 256.9], (512, 512)
DISTORTION = [0.0034823894, 0.0007150348, -0.0020532361, 0.0002029367]


def directions(max_angle: float, count: int, generator: torch.Generator) -> torch.Tensor:
    angle = torch.rand(count, generator=generator, dtype=torch.float64) * max_angle
    azimuth = torch.rand(count, generator=generator, dtype=torch.float64) * 2 * math.pi
    return torch.stack((angle.sin() * azimuth.cos(), angle.sin() * azimuth.sin(), angle.cos()), -1)


def kannala_brandt() -> KannalaBrandtCamera:
    return KannalaBrandtCamera(*double(FOCAL, CENTER, DISTORTION), SIZE, math.radians(100))


def test_kannala_brandt_against_opencv_below_80_degrees(generator: torch.Generator) -> None:
    points = directions(math.radians(79), 300, generator)
    matrix = np.array([[FOCAL[0], 0, CENTER[0]], [0, FOCAL[1], CENTER[1]], [0, 0, 1]])
    zero = np.zeros(3)
    expected, _ = cv2.fisheye.projectPoints(points.numpy()[:, None], zero, zero, matrix, np.array(DISTORTION))
    camera = kannala_brandt()
    pixels, _ = camera.project(points)
    np.testing.assert_allclose(pixels, expected[:, 0], atol=1e-9)
    plane = cv2.fisheye.undistortPoints(expected, matrix, np.array(DISTORTION))[:, 0]
    ours = camera.unproject(pixels).directions
    np.testing.assert_allclose(ours[:, :2] / ours[:, 2:], plane, rtol=1e-5, atol=1e-5)


def test_kannala_brandt_past_90_degrees_by_its_polynomial() -> None:
    angle = math.radians(98)
    radius = angle * (1 + sum(k * angle ** (2 * i + 2) for i, k in enumerate(DISTORTION)))
    point = torch.tensor([0.6 * math.sin(angle), 0.8 * math.sin(angle), math.cos(angle)], dtype=torch.float64)
    camera = kannala_brandt()
    pixels, valid = camera.project(point)
    expected = [CENTER[0] + FOCAL[0] * radius * 0.6, CENTER[1] + FOCAL[1] * radius * 0.8]
    np.testing.assert_allclose(pixels, expected, atol=1e-10)
    assert valid
    np.testing.assert_allclose(camera.unproject(pixels).directions, point, atol=1e-12)


def test_kannala_brandt_ends_where_its_radius_turns() -> None:
    """θ − θ³/3 grows up to 1 rad: further directions and radii are not valid."""
    camera = KannalaBrandtCamera(
        *double([100.0, 100.0], [200.0, 200.0], [-1 / 3, 0.0, 0.0, 0.0]), (401, 401), math.pi
    )
    angles = torch.tensor([0.5, 0.98, 1.02, 1.6], dtype=torch.float64)
    points = torch.stack((angles.sin(), torch.zeros(4), angles.cos()), -1)
    assert camera.project(points).valid.tolist() == [True, True, False, False]
    radii = torch.tensor([[200.0 + 60, 200.0], [200.0 + 70, 200.0]], dtype=torch.float64)
    assert camera.unproject(radii).valid.tolist() == [True, False]  # the largest radius is 2/3 focal lengths


@pytest.mark.parametrize(
    ("projection", "radius"),
    [
        ("equidistant", lambda t: t),
        ("equisolid", lambda t: 2 * math.sin(t / 2)),
        ("stereographic", lambda t: 2 * math.tan(t / 2)),
        ("orthographic", math.sin),
    ],
)
def test_fisheye_radii_are_the_textbook_formulas(projection: str, radius: object) -> None:
    for angle in (1e-6, 0.3, 1.0, 1.5, 1.9, 3.0):
        point = torch.tensor([0.0, -math.sin(angle), math.cos(angle)], dtype=torch.float64)
        pixels, valid = project_fisheye(point, *double([100.0], [0.0, 0.0]), projection)
        assert bool(valid) == (projection != "orthographic" or angle < math.pi / 2)
        assert pixels[1].item() == pytest.approx(-100 * radius(angle), rel=1e-9)


@pytest.mark.parametrize(
    ("projection", "edge"),
    [("equidistant", math.pi), ("equisolid", 2.0), ("orthographic", 1.0)],
)
def test_pixels_beyond_what_a_projection_can_show_are_not_valid(projection: str, edge: float) -> None:
    """The whole sphere ends at π focal lengths (equidistant), 2 (equisolid), and half of it at 1 (orthographic)."""
    camera = FisheyeCamera(projection, *double(100.0, [400.0, 400.0]), (801, 801))
    radii = 100 * edge * torch.tensor([0.999, 1.001, 1.2], dtype=torch.float64)
    pixels = torch.stack((400 + radii, torch.full_like(radii, 400.0)), -1)
    assert camera.contains(pixels).all()
    assert camera.unproject(pixels).valid.tolist() == [True, False, False]


def test_a_fold_is_found_to_a_millionth_of_a_radian() -> None:
    """θ − θ³/3 turns at 1 rad, which lies between the samples that look for it."""
    camera = KannalaBrandtCamera(*double([100.0, 100.0], [200.0, 200.0], [-1 / 3, 0.0, 0.0, 0.0]), (401, 401))
    assert camera.max_angle.item() == pytest.approx(1.0, abs=1e-7)
    angles = 1 + torch.tensor([-1e-6, 1e-6], dtype=torch.float64)
    points = torch.stack((angles.sin(), torch.zeros(2), angles.cos()), -1)
    assert camera.with_max_angle(math.pi).project(points).valid.tolist() == [True, False]


def test_models_end_where_they_end_by_default() -> None:
    sphere = DoubleSphereCamera([100.0, 100.0], [99.5, 99.5], -0.2, 0.6, (200, 200))
    edge = sphere.max_angle.item()
    wider = sphere.with_max_angle(math.pi)
    angles = edge + torch.tensor([-1e-3, 1e-3])
    points = torch.stack((angles.sin(), torch.zeros(2), angles.cos()), -1)
    assert wider._project(points).valid.tolist() == [True, False]
    assert FisheyeCamera("orthographic", 50.0, [99.5, 99.5], (200, 200)).max_angle.item() == pytest.approx(
        math.pi / 2
    )


def test_one_focal_length_for_each_camera_or_for_each_direction() -> None:
    centers = torch.tensor([[10.0, 20.0], [30.0, 40.0]])
    same = FisheyeCamera("equidistant", torch.tensor([50.0, 50.0]), centers, (100, 100), 1.0)
    pair = FisheyeCamera("equidistant", torch.tensor([[50.0, 50.0]]), centers, (100, 100), 1.0)
    assert same.batch_shape == pair.batch_shape == (2,)
    points = torch.tensor([0.3, 0.2, 1.0]).expand(2, 1, 3)
    torch.testing.assert_close(same.project(points).pixels, pair.project(points).pixels)
    with pytest.raises(ArgumentError, match=r"write \(2, 1\) or \(1, 2\)"):
        FisheyeCamera("equidistant", torch.tensor([50.0, 60.0]), centers, (100, 100), 1.0)
    each = FisheyeCamera("equidistant", torch.tensor([50.0, 60.0, 70.0]), [10.0, 20.0], (100, 100), 1.0)
    assert each.batch_shape == (3,)
    assert each.select(1).focal_length.tolist() == [60.0]


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_convention_half_precision_is_computed_in_float32(dtype: torch.dtype) -> None:
    lens = [torch.tensor(values).to(dtype) for values in (FOCAL, CENTER, DISTORTION)]
    points = torch.tensor([[0.3, 0.2, 1.0], [1.0, 0.5, -0.1]]).to(dtype)
    pixels, valid = project_kannala_brandt(points, *lens)
    assert torch.equal(
        pixels, project_kannala_brandt(points.float(), *(tensor.float() for tensor in lens)).pixels
    )
    assert valid.all()
    directions = unproject_kannala_brandt(pixels.to(dtype), *lens).directions
    assert directions.dtype == torch.float32
    with pytest.raises(ArgumentError, match="points: expected floating point"):
        project_kannala_brandt(torch.tensor([[0, 0, 1]]), *lens)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_depth_in_half_precision_lies_along_the_pixels_own_rays(dtype: torch.dtype) -> None:
    """Half precision counts to 2048 or 256."""
    camera = FisheyeCamera.from_field_of_view((40, 4000), 3.0)
    depth = torch.full((40, 4000), 4.0)
    points, valid = points_from_depth(depth.to(dtype), camera)
    torch.testing.assert_close(points, points_from_depth(depth, camera)[0])
    assert valid.any()


def test_fisheye_from_field_of_view_fills_the_shorter_side() -> None:
    camera = FisheyeCamera.from_field_of_view((768, 800), math.radians(220), dtype=torch.float64)
    edge = math.radians(110)
    up = torch.tensor([0.0, -math.sin(edge), math.cos(edge)], dtype=torch.float64)
    pixels = camera.project(up).pixels
    np.testing.assert_allclose(pixels, [399.5, -0.5], atol=1e-9)
    assert camera.max_angle.item() == pytest.approx(edge)
    inside = torch.tensor([0.0, -math.sin(edge - 1e-6), math.cos(edge - 1e-6)], dtype=torch.float64)
    assert camera.project(inside).valid


def test_double_sphere_by_its_definition(generator: torch.Generator) -> None:
    """Projected onto two unit spheres, the second shifted by xi, then by a pinhole shifted by alpha / (1 − alpha)."""
    xi, alpha = -0.28, 0.57
    camera = DoubleSphereCamera(
        *double([225.0, 222.6], [610.8, 612.7], xi, alpha), (1216, 1216), math.radians(115)
    )
    points = directions(math.radians(110), 200, generator) * 4
    on_first = points / points.norm(dim=-1, keepdim=True)
    shifted = on_first + torch.tensor([0.0, 0.0, xi], dtype=torch.float64)
    on_second = shifted / shifted.norm(dim=-1, keepdim=True)
    plane = on_second[:, :2] / (on_second[:, 2:] + alpha / (1 - alpha))
    expected = plane / (1 - alpha) * double([225.0, 222.6])[0] + double([610.8, 612.7])[0]
    pixels, _ = camera.project(points)
    torch.testing.assert_close(pixels, expected, rtol=0, atol=1e-9)


def test_double_sphere_without_spheres_is_a_pinhole(generator: torch.Generator) -> None:
    points = directions(1.0, 50, generator)
    sphere = DoubleSphereCamera(*double([100.0, 100.0], [80.0, 60.0], 0.0, 0.0), (121, 161), math.pi)
    pinhole = PinholeCamera(*double([100.0, 100.0], [80.0, 60.0]), (121, 161))
    torch.testing.assert_close(sphere.project(points).pixels, pinhole.project(points).pixels)
    assert not sphere.project(torch.tensor([0.0, 0.1, -1.0])).valid
    assert not pinhole.project(torch.tensor([0.0, 0.0, -1.0])).valid


def test_convention_equirectangular() -> None:
    """Forward is the middle column, longitude grows to the right, latitude is +π/2 at the top row."""
    camera = EquirectangularCamera((100, 200))
    points = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    pixels = camera.project(points).pixels
    np.testing.assert_allclose(pixels[:3], [[99.5, 49.5], [149.5, 49.5], [49.5, 49.5]], atol=1e-4)
    assert pixels[3, 1].item() == pytest.approx(-0.5, abs=1e-5)
    longitude = torch.atan2(*camera.unproject(torch.tensor([3.0, 49.5])).directions[[0, 2]])
    assert longitude.item() == pytest.approx((3 + 0.5) * 2 * math.pi / 200 - math.pi, rel=1e-5)


def test_equirectangular_sees_across_its_seam() -> None:
    """Just left and right of straight back, interpolation takes both border columns."""
    camera = EquirectangularCamera((4, 8))
    image = torch.zeros(1, 4, 8)
    image[..., 0], image[..., -1] = 1.0, 3.0
    back = torch.tensor([[0.0, 0.0, -1.0], [-1e-4, 0.0, -1.0], [1e-4, 0.0, -1.0]])
    values, valid = camera.sample(image, back)
    assert valid.all()
    torch.testing.assert_close(values, torch.full((1, 3), 2.0), rtol=0, atol=1e-3)


def test_equirectangular_band_shows_part_of_the_latitudes() -> None:
    camera = EquirectangularCamera((160, 640), math.pi / 2)
    up, below = math.radians(44), math.radians(-46)
    points = torch.tensor([[0.0, -math.sin(a), math.cos(a)] for a in (up, below)])
    assert camera.project(points).valid.tolist() == [True, False]


def test_the_outermost_rows_of_a_band_do_not_mix_with_the_opposite_side() -> None:
    camera = EquirectangularCamera((4, 8), vertical_field_of_view=math.pi / 2)
    image = torch.arange(8.0).expand(1, 4, 8)
    pixels = torch.tensor([[2.0, -0.4], [2.0, 0.0], [5.0, 3.4]])
    values, valid = camera.sample(image, camera.unproject(pixels).directions)
    assert valid.all()
    torch.testing.assert_close(values, torch.tensor([[2.0, 2.0, 5.0]]), atol=1e-4, rtol=0)


def test_axis_of_the_image_size_is_height_first() -> None:
    assert EquirectangularCamera((10, 20)).pixel_grid().shape == (10, 20, 2)
