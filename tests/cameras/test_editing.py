# SPDX-License-Identifier: Apache-2.0
"""Resized and cropped cameras keep every ray: the law is that of the pixels, whatever the model."""

from __future__ import annotations

import pytest
import torch

from sphericalvision.cameras import Camera, EquirectangularCamera, PinholeCamera
from tests.laws.cameras import MODELS

SIZES = [(48, 56), (192, 224), (96, 200), (31, 112)]  # halved, doubled, stretched, squeezed, of (96, 112)
CROP = (11, 7, 60, 90)  # top, left, height, width


@pytest.fixture(params=MODELS)
def camera(request: pytest.FixtureRequest) -> Camera:
    return MODELS[request.param](1.0).to(torch.float64)


def test_the_same_rays_go_through_resized_pixels(camera: Camera) -> None:
    pixels = camera.pixel_grid()[::5, ::5].reshape(-1, 2)
    directions, valid = camera.unproject(pixels)
    for size in SIZES:
        resized = camera.resized(size)
        assert resized.image_size == size
        stretch = torch.tensor(size[::-1], dtype=torch.float64) / torch.tensor(camera.image_size[::-1])
        moved = (pixels + 0.5) * stretch - 0.5
        again, still = resized.unproject(moved)
        torch.testing.assert_close(again, directions, rtol=0, atol=1e-12)
        assert torch.equal(still, valid)
        torch.testing.assert_close(
            resized.project(directions).pixels[valid],
            (camera.project(directions).pixels[valid] + 0.5) * stretch - 0.5,
            rtol=0,
            atol=1e-9,
        )


def test_the_same_rays_go_through_cropped_pixels(camera: Camera) -> None:
    top, left, height, width = (2, 1, 30, 40) if isinstance(camera, EquirectangularCamera) else CROP
    cropped = camera.cropped(top, left, height, width)
    whole = camera.pixel_grid()[top : top + height, left : left + width]
    directions, valid = camera.unproject(whole)
    again, still = cropped.unproject(cropped.pixel_grid())
    torch.testing.assert_close(again, directions, rtol=0, atol=1e-12)
    assert torch.equal(still, valid)
    pixels, seen = cropped.project(camera.unproject(camera.pixel_grid()).directions)
    inside = torch.zeros(camera.image_size, dtype=torch.bool)
    inside[top : top + height, left : left + width] = True
    outermost = (pixels[..., 0] + 0.5).abs().minimum((pixels[..., 1] + 0.5).abs()) < 1e-6
    assert not (seen & ~inside & ~outermost).any(), "what was cropped away is not seen"


def test_gradients_reach_the_intrinsics_through_resizing() -> None:
    focal_length = torch.tensor([500.0, 500.0], requires_grad=True)
    camera = PinholeCamera(focal_length, [319.5, 239.5], (480, 640)).resized((240, 160))
    camera.project(torch.tensor([1.0, 1.0, 2.0])).pixels.sum().backward()
    torch.testing.assert_close(focal_length.grad, torch.tensor([0.125, 0.25]))
