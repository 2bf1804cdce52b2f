# SPDX-License-Identifier: Apache-2.0
"""A band of latitudes is the middle of the whole panorama."""

from __future__ import annotations

import math

import pytest
import torch

from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.sphere import Equirectangular, EquirectangularBand


def test_the_whole_sphere_is_the_equirectangular_grid() -> None:
    band, grid = EquirectangularBand(6, 12), Equirectangular(6, 12)
    torch.testing.assert_close(band.directions, grid.directions)
    torch.testing.assert_close(band.solid_angles, grid.solid_angles)
    torch.testing.assert_close(band.pixels(grid.directions), grid.pixels(grid.directions))
    assert band.whole_sphere


def test_rows_of_the_whole_panorama_have_the_bands_directions() -> None:
    band, grid = EquirectangularBand(4, 16), Equirectangular(8, 16)
    rows = band.rows_of(grid.directions.permute(2, 0, 1)).permute(1, 2, 0)
    torch.testing.assert_close(rows, band.directions)
    assert band.rows_of(rows[..., 0]) is not None
    assert torch.equal(band.rows_of(rows[..., 0]), rows[..., 0])
    assert not band.whole_sphere
    assert band.max_latitude == math.pi / 4


def test_latitudes_decide_what_is_inside() -> None:
    latitude = torch.deg2rad(torch.tensor([-90.0, -45.1, -44.9, 0.0, 44.9, 45.1, 90.0]))
    directions = torch.stack((torch.zeros(7), -latitude.sin(), latitude.cos()), -1)
    inside = [False, False, True, True, True, False, False]
    assert EquirectangularBand(4, 16).contains(directions).tolist() == inside
    assert EquirectangularBand(8, 16).contains(directions).all()


@pytest.mark.parametrize("height", [4, 8])
def test_samples_are_linear_in_pixels_and_continue_at_the_edges(
    height: int, generator: torch.Generator
) -> None:
    band = EquirectangularBand(height, 16)
    values = torch.randn(2, 3, height, 16, generator=generator)
    centres = band.sample(values, band.directions.flatten(0, 1))
    torch.testing.assert_close(centres.unflatten(-1, band.shape), values, rtol=0, atol=1e-4)
    behind = torch.tensor([[0.0, 0.0, -1.0]])  # between the last column and the first, and two rows
    middle = values[..., height // 2 - 1 : height // 2 + 1, :]
    torch.testing.assert_close(band.sample(values, behind)[..., 0], middle[..., [0, -1]].mean((-2, -1)))


def test_wrong_sizes_are_named() -> None:
    with pytest.raises(ArgumentError, match="at most half the width"):
        EquirectangularBand(5, 8)
    band = EquirectangularBand(2, 8)
    with pytest.raises(ShapeError, match=r"\(2, 8\) or \(4, 8\) for the whole sphere, got \(3, 8\)"):
        band.rows_of(torch.zeros(3, 8))
    with pytest.raises(ShapeError, match=r"\(\*, 2, 8\)"):
        band.sample(torch.zeros(8, 2), torch.ones(1, 3))
