# SPDX-License-Identifier: Apache-2.0
"""What laws and formulas do not say of models: conventions, focal lengths of batches, seams and bands of panoramas."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from sphericalvision.cameras import (
    EquirectangularCamera,
    FisheyeCamera,
    points_from_depth,
    project_kannala_brandt,
    unproject_kannala_brandt,
)

FOCAL, CENTER, SIZE = [190.97, 188.3], [254.93, 256.9], (512, 512)
DISTORTION = [0.0034823894, 0.0007150348, -0.0020532361, 0.0002029367]


def test_one_focal_length_for_each_camera_or_for_each_direction() -> None:
    centers = torch.tensor([[10.0, 20.0], [30.0, 40.0]])
    same = FisheyeCamera("equidistant", torch.tensor([50.0, 50.0]), centers, (100, 100), 1.0)
    pair = FisheyeCamera("equidistant", torch.tensor([[50.0, 50.0]]), centers, (100, 100), 1.0)
    assert same.batch_shape == pair.batch_shape == (2,)
    points = torch.tensor([0.3, 0.2, 1.0]).expand(2, 1, 3)
    torch.testing.assert_close(same.project(points).pixels, pair.project(points).pixels)
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


def test_the_outermost_rows_of_a_band_do_not_mix_with_the_opposite_side() -> None:
    camera = EquirectangularCamera((4, 8), vertical_field_of_view=math.pi / 2)
    image = torch.arange(8.0).expand(1, 4, 8)
    pixels = torch.tensor([[2.0, -0.4], [2.0, 0.0], [5.0, 3.4]])
    values, valid = camera.sample(image, camera.unproject(pixels).directions)
    assert valid.all()
    torch.testing.assert_close(values, torch.tensor([[2.0, 2.0, 5.0]]), atol=1e-4, rtol=0)
