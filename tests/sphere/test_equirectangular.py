# SPDX-License-Identifier: Apache-2.0
"""Panoramas of all latitudes and of those near the horizon: convention, and the pixel taken for a direction."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from sphericalvision.cameras import EquirectangularCamera, remap, remap_mask
from sphericalvision.geometry import directions_from_longitude_latitude
from sphericalvision.icosphere import Icosphere
from sphericalvision.sphere import Cubemap, Equirectangular, resample, resample_mask

square = Equirectangular.with_square_pixels
DOUBLE = torch.float64


def test_square_pixels_over_the_whole_sphere_are_the_ordinary_grid() -> None:
    grid, same = square(6, 12), Equirectangular(6, 12)
    assert torch.equal(grid.directions, same.directions)
    assert torch.equal(grid.solid_angles, same.solid_angles)
    assert grid.whole_sphere
    assert repr(grid) == repr(same)


def test_square_pixels_of_a_low_panorama_lie_near_the_horizon() -> None:
    part, limits = square(16, 64), (-math.pi / 4, math.pi / 4)
    torch.testing.assert_close(part.directions, Equirectangular(16, 64, latitudes=limits).directions)
    rows = torch.arange(32)[:, None].expand(32, 64)
    assert torch.equal(part.rows_of(rows), rows[8:24])
    assert torch.equal(part.rows_of(rows[8:24]), rows[8:24])
    assert part.max_latitude == math.pi / 4
    assert not part.whole_sphere


def test_latitudes_decide_what_is_inside() -> None:
    latitude = torch.deg2rad(torch.tensor([-90.0, -45.1, -44.9, 0.0, 44.9, 45.1, 90.0]))
    directions = torch.stack((torch.zeros(7), -latitude.sin(), latitude.cos()), -1)
    assert square(160, 640).contains(directions).tolist() == [False, False, True, True, True, False, False]
    assert Equirectangular(8, 16).contains(directions).all()
    assert Equirectangular(10, 16, max_latitude=0.1).contains(directions).tolist() == [
        i == 3 for i in range(7)
    ]


def test_limits_are_a_part_of_the_whole_for_grid_and_camera_alike() -> None:
    """Rows and columns of a whole panorama; a strip's rows; a front that is cut out, and one that looks back."""
    turn = math.pi / 16
    whole, camera = Equirectangular(16, 32, DOUBLE), EquirectangularCamera((16, 32)).to(DOUBLE)
    values = torch.rand(2, 16, 32, dtype=DOUBLE)
    for rows, columns in (
        (slice(2, 9), slice(0, 32)),
        (slice(4, 12), slice(0, 32)),
        (slice(0, 5), slice(3, 20)),
        (slice(4, 16), slice(20, 40)),
    ):
        latitudes = (math.pi / 2 - rows.stop * turn, math.pi / 2 - rows.start * turn)
        longitudes = (columns.start * turn - math.pi, columns.stop * turn - math.pi)
        size = (rows.stop - rows.start, columns.stop - columns.start)
        part = Equirectangular(*size, DOUBLE, latitudes=latitudes, longitudes=longitudes)
        lens = EquirectangularCamera(size, latitudes=latitudes, longitudes=longitudes).to(DOUBLE)
        index = torch.arange(columns.start, columns.stop) % 32
        torch.testing.assert_close(part.directions, whole.directions[rows][:, index], atol=1e-12, rtol=0)
        torch.testing.assert_close(part.solid_angles, whole.solid_angles[rows][:, index])
        found = resample(values, whole, part)
        torch.testing.assert_close(found, values[:, rows, index], atol=1e-12, rtol=0)
        torch.testing.assert_close(remap(values, camera, lens), found, atol=1e-12, rtol=0)
        assert torch.equal(remap_mask(lens, camera), resample_mask(part, whole))
        there = resample_mask(part, whole)
        assert there.sum() == math.prod(size)
        back = resample(found, part, whole, mode="nearest")[:, there]
        torch.testing.assert_close(back, values[:, there], atol=1e-12, rtol=0)
        if columns.stop <= 32:
            cropped = camera.cropped(rows.start, columns.start, *size)
            assert cropped.latitudes == pytest.approx(lens.latitudes)
            assert cropped.longitudes == pytest.approx(lens.longitudes)
    strip = Equirectangular(7, 32, latitudes=(math.pi / 2 - 9 * turn, math.pi / 2 - 2 * turn))
    assert torch.equal(strip.rows_of(values), values[:, 2:9])
    assert strip.image_edges == "around"


def test_the_outermost_rows_are_repeated_beyond_the_latitudes() -> None:
    """What is on the other side of the sphere has no part in the half pixel up to the edge, nor beyond it."""
    grid = square(4, 16, DOUBLE)
    values = torch.rand(1, 4, 16, dtype=DOUBLE)
    latitude = torch.tensor([44.9, 60.0], dtype=DOUBLE).deg2rad()
    longitude = torch.atan2(grid.directions[0, 3, 0], grid.directions[0, 3, 2])
    level = latitude.cos()
    above = torch.stack((level * longitude.sin(), -latitude.sin(), level * longitude.cos()), -1)
    torch.testing.assert_close(grid.sample(values, above)[0], values[0, 0, 3].expand(2))


def test_the_mask_of_a_part_of_the_sphere_is_what_it_contains() -> None:
    part, cube = square(16, 64, DOUBLE), Cubemap(8, DOUBLE)
    inside = part.contains(cube.directions)
    for mode in ("bilinear", "nearest", "area"):
        valid = resample_mask(part, cube, mode=mode)
        assert valid[inside].all()
        assert torch.equal(valid, inside) or mode == "area"  # the mean over what is seen of a cell
        assert valid.double().mean() < 1


def test_nearest_in_longitude_and_latitude_by_brute_force(generator: torch.Generator) -> None:
    directions = torch.nn.functional.normalize(torch.randn(500, 3, generator=generator, dtype=DOUBLE), dim=-1)
    grid = Equirectangular(32, 64, DOUBLE)
    longitudes = torch.atan2(grid.directions[0, :, 0], grid.directions[0, :, 2])
    latitudes = torch.asin(-grid.directions[:, 0, 1])
    around = (torch.atan2(directions[:, 0], directions[:, 2])[:, None] - longitudes).abs()
    column = torch.minimum(around, 2 * math.pi - around).argmin(-1)
    row = (torch.asin(-directions[:, 1])[:, None] - latitudes).abs().argmin(-1)
    assert torch.equal(grid.nearest(directions), row * 64 + column)


def test_midway_between_columns_the_even_one_is_taken() -> None:
    """Whatever the last bit of a direction says: whole meridians of an icosphere lie there."""
    grid = Equirectangular(4, 8)
    longitude = torch.arange(-4, 5, dtype=DOUBLE) * (math.pi / 4)
    for error in (-1e-9, 0.0, 1e-9):
        turned = longitude.clamp(-math.pi + 1e-8, math.pi - 1e-8) + error
        directions = torch.stack((turned.sin(), torch.full_like(turned, -0.3), turned.cos()), -1)
        assert (grid.nearest(directions) % 8).tolist() == [0, 0, 2, 2, 4, 4, 6, 6, 7]


def test_same_samples_as_the_published_implementation(golden: Path) -> None:
    numbers = np.load(golden / "image_io.npz")
    panorama = cv2.resize(numbers["idepth_lowres"], (640, 320), interpolation=cv2.INTER_LINEAR)
    grid = Icosphere(2, DOUBLE)
    ids = Equirectangular(320, 640).nearest(grid.vertices)
    expected = numbers["ico_idepth"][grid.subdivision_order.numpy()]
    # At a pole every column is nearest; there the published choice is a matter of rounding.
    np.testing.assert_allclose(panorama.flatten()[ids][1:-1], expected[1:-1], atol=1e-12)


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
