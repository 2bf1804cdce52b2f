# SPDX-License-Identifier: Apache-2.0
"""Bilinear interpolation, against OpenCV, a plain loop and functions that it reproduces exactly."""

import cv2
import numpy as np
import torch

from sphericalvision.geometry import bilinear_sample


def grid(height: int, width: int) -> torch.Tensor:
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return torch.stack((u, v), -1).reshape(-1, 2).double()


def test_convention_pixel_centers(generator: torch.Generator) -> None:
    """Pixel centres are integers: sampling at them returns the image, at (0, 0) its top-left pixel."""
    image = torch.rand(3, 5, 7, generator=generator, dtype=torch.float64)
    values = bilinear_sample(image, grid(5, 7))
    torch.testing.assert_close(values.reshape(3, 5, 7), image, rtol=0, atol=1e-12)
    torch.testing.assert_close(values[:, 0], image[:, 0, 0], rtol=0, atol=1e-12)


def test_against_opencv_remap(generator: torch.Generator) -> None:
    image = torch.rand(20, 30, generator=generator)
    pixels = torch.rand(200, 2, generator=generator) * torch.tensor([29.0, 19.0])
    pixels = (pixels * 32).round() / 32  # OpenCV's remap works with 1/32 pixel
    u, v = np.ascontiguousarray(pixels.numpy().T)
    expected = cv2.remap(image.numpy(), u[None], v[None], cv2.INTER_LINEAR)[0]
    np.testing.assert_allclose(bilinear_sample(image[None], pixels)[0], expected, atol=1e-4)


def test_padding() -> None:
    image = torch.ones(1, 3, 3, dtype=torch.float64)
    outside = torch.tensor([[-0.5, 1.0], [-3.0, 1.0]], dtype=torch.float64)
    assert bilinear_sample(image, outside).tolist() == [[1, 1]]
    torch.testing.assert_close(
        bilinear_sample(image, outside, padding="zeros"), torch.tensor([[0.5, 0.0]], dtype=torch.float64)
    )


def test_panorama_wraps_at_the_seam_and_beyond_the_poles(generator: torch.Generator) -> None:
    image = torch.rand(1, 4, 8, generator=generator, dtype=torch.float64)
    pixels = torch.tensor(
        [[-0.25, 1.0], [7.75, 1.0], [15.75, 1.0], [2.0, -0.5], [2.0, 3.5]], dtype=torch.float64
    )
    seam = 0.75 * image[0, 1, 0] + 0.25 * image[0, 1, 7]
    other = 0.25 * image[0, 1, 0] + 0.75 * image[0, 1, 7]
    north = (image[0, 0, 2] + image[0, 0, 6]) / 2
    south = (image[0, 3, 2] + image[0, 3, 6]) / 2
    expected = torch.stack((seam, 0.25 * image[0, 1, 7] + 0.75 * image[0, 1, 0], seam, north, south))
    values = bilinear_sample(image, pixels, wrap_longitude=True)[0]
    torch.testing.assert_close(values, expected)
    right = bilinear_sample(image, torch.tensor([[7.25, 1.0]], dtype=torch.float64), wrap_longitude=True)
    torch.testing.assert_close(right[0, 0], other)


def test_leading_dimensions_broadcast(generator: torch.Generator) -> None:
    images = torch.rand(2, 3, 1, 5, 6, generator=generator)
    pixels = torch.rand(3, 11, 2, generator=generator) * 4
    together = bilinear_sample(images, pixels)
    assert together.shape == (2, 3, 1, 11)
    for i in range(2):
        for j in range(3):
            torch.testing.assert_close(together[i, j], bilinear_sample(images[i, j], pixels[j]))
