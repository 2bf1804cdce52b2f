# SPDX-License-Identifier: Apache-2.0
"""The equirectangular grid: convention, exactness at the seam and the poles, solid angles."""

import math

import pytest
import torch

from sphericalvision.geometry import directions_from_longitude_latitude
from sphericalvision.sphere import Equirectangular

SIZES = [(1, 1), (4, 8), (5, 9), (6, 7), (16, 64)]


def test_convention_equirectangular() -> None:
    """Forward is the middle, +x a quarter to the right, up the top; pixel i has longitude (i + 0.5)·2π/W - π."""
    grid = Equirectangular(6, 8, dtype=torch.float64)
    axes = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, -1, 0], [-1, 0, 0]], dtype=torch.float64)
    expected = torch.tensor([[3.5, 2.5], [5.5, 2.5], [3.5, -0.5], [1.5, 2.5]], dtype=torch.float64)
    torch.testing.assert_close(grid.pixels(axes), expected)
    longitude, latitude = (0 + 0.5) * 2 * math.pi / 8 - math.pi, math.pi / 2 - (0 + 0.5) * math.pi / 6
    top_left = directions_from_longitude_latitude(*torch.tensor([longitude, latitude], dtype=torch.float64))
    torch.testing.assert_close(grid.directions[0, 0], top_left)


@pytest.mark.parametrize("size", SIZES)
def test_pixels_of_own_directions(size: tuple[int, int]) -> None:
    grid = Equirectangular(*size, dtype=torch.float64)
    rows, columns = torch.meshgrid(*map(torch.arange, size), indexing="ij")
    expected = torch.stack((columns, rows), -1).double()
    torch.testing.assert_close(grid.pixels(grid.directions), expected, rtol=0, atol=1e-12)
    assert torch.equal(grid.nearest(grid.directions).flatten(), torch.arange(size[0] * size[1]))
