# SPDX-License-Identifier: Apache-2.0
"""The panorama grid against its definition, brute force, and the published implementation's samples."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from sphericalvision.core import ShapeError
from sphericalvision.data.omnistereo.panorama_grid import latitude_limit, nearest_pixels, panorama_directions
from sphericalvision.icosphere import Icosphere


def test_convention_forward_is_the_middle_and_up_the_top() -> None:
    directions = panorama_directions(320, 640)
    half = math.pi / 640
    torch.testing.assert_close(
        directions[0, 0, 1], torch.tensor(-math.cos(half))
    )  # half a pixel from straight up
    # pixel 319.5 would look forward; its neighbour to the right looks a little to the right
    assert directions[160, 320].tolist() == pytest.approx(
        [math.sin(half) * math.cos(half), math.sin(half), math.cos(half) ** 2], abs=1e-6
    )


def test_urban_panoramas_are_the_middle_rows_of_full_ones() -> None:
    torch.testing.assert_close(panorama_directions(16, 64), panorama_directions(32, 64)[8:24])


@pytest.mark.parametrize("height", [32, 16])
def test_pixel_centres_find_themselves(height: int) -> None:
    ids, valid = nearest_pixels(panorama_directions(height, 64, torch.float64), height, 64)
    assert torch.equal(ids.flatten(), torch.arange(height * 64))
    assert valid.all()


def test_nearest_in_angle_by_brute_force(generator: torch.Generator) -> None:
    """Away from the poles the nearest pixel on the grid is within half a step in longitude and latitude."""
    directions = torch.nn.functional.normalize(
        torch.randn(500, 3, generator=generator, dtype=torch.float64), dim=-1
    )
    pixels = panorama_directions(32, 64, torch.float64)
    ids, _ = nearest_pixels(directions, 32, 64)
    longitudes = torch.atan2(pixels[0, :, 0], pixels[0, :, 2])
    latitudes = torch.asin(-pixels[:, 0, 1])
    around = (torch.atan2(directions[:, 0], directions[:, 2])[:, None] - longitudes).abs()
    column = torch.minimum(around, 2 * math.pi - around).argmin(-1)
    row = (torch.asin(-directions[:, 1])[:, None] - latitudes).abs().argmin(-1)
    assert torch.equal(ids, row * 64 + column)


def test_directions_beyond_45_degrees_are_outside_of_urban_panoramas() -> None:
    latitude = torch.tensor([44.9, 45.1, -44.9, -45.1]) * math.pi / 180
    directions = torch.stack((torch.zeros(4), -latitude.sin(), latitude.cos()), dim=-1)
    assert nearest_pixels(directions, 160, 640).valid.tolist() == [True, False, True, False]
    assert nearest_pixels(directions, 320, 640).valid.all()


def test_other_proportions_are_refused() -> None:
    with pytest.raises(ShapeError, match=r"height 3, width 7"):
        latitude_limit(3, 7)


def test_same_samples_as_the_published_implementation(golden: Path) -> None:
    numbers = np.load(golden / "image_io.npz")
    panorama = cv2.resize(numbers["idepth_lowres"], (640, 320), interpolation=cv2.INTER_LINEAR)
    grid = Icosphere(2, torch.float64)
    ids, _ = nearest_pixels(grid.vertices, 320, 640)
    expected = numbers["ico_idepth"][grid.subdivision_order.numpy()]
    # At a pole every column is nearest; there the published choice is a matter of rounding.
    np.testing.assert_allclose(panorama.flatten()[ids][1:-1], expected[1:-1], atol=1e-12)
