# SPDX-License-Identifier: Apache-2.0
"""Cube maps: their convention, their layouts, and images that come out of panoramas."""

import math

import pytest
import torch

from sphericalvision.cameras import PinholeCamera
from sphericalvision.sphere import Cubemap, Equirectangular, cube_to_layout, resample
from sphericalvision.sphere.grids.cube_layouts import world_from_cube_face
from tests.laws.grid_laws import DOUBLE, some_rotation, spread_directions


def test_convention_cubemap() -> None:
    """Front, right, back, left, up, down; rows grow downwards; up and down hang on the front face."""
    grid = Cubemap(2, dtype=DOUBLE)
    forward = [[0, 0, 1], [1, 0, 0], [0, 0, -1], [-1, 0, 0], [0, -1, 0], [0, 1, 0]]
    middle = grid.directions.flatten(1, 2).mean(1)
    torch.testing.assert_close(
        middle / middle.norm(dim=-1, keepdim=True), torch.tensor(forward, dtype=DOUBLE)
    )
    expected = torch.tensor([-0.5, -0.5, 1.0], dtype=DOUBLE) / math.sqrt(1.5)
    torch.testing.assert_close(grid.directions[0, 0, 0], expected)  # front, top left: left and up
    assert grid.directions[4, 1, 0] @ grid.directions[0, 0, 0] > 0.66  # neighbours across the edge
    assert grid.directions[5, 0, 1] @ grid.directions[0, 1, 1] > 0.66
    for name, axes in zip(grid.faces, world_from_cube_face(DOUBLE), strict=True):
        assert torch.linalg.det(axes) == 1, name


@pytest.mark.parametrize("size", [1, 2, 5, 8])
def test_interpolation_is_continuous_everywhere(size: int) -> None:
    """A nudge across any edge, corner or pixel border changes a value as little as the nudge."""
    grid = Cubemap(size, dtype=DOUBLE)
    values = torch.randn(1, 6, size, size, dtype=DOUBLE)
    directions = spread_directions(20_000)
    nudged = directions + 1e-9 * torch.randn(20_000, 3, dtype=DOUBLE)
    assert (grid.sample(values, directions) - grid.sample(values, nudged)).abs().max() < 1e-6
    assert grid.sample(values, directions).abs().max() <= values.abs().max()


def test_corners_and_edges_are_what_they_touch() -> None:
    grid = Cubemap(4, dtype=DOUBLE)
    values = torch.randn(1, 6, 4, 4, dtype=DOUBLE)
    corner = grid.sample(values, torch.tensor([[1.0, -1.0, 1.0]], dtype=DOUBLE)).item()
    assert corner == pytest.approx(
        ((values[0, 0, 0, 3] + values[0, 1, 0, 0] + values[0, 4, 3, 3]) / 3).item()
    )
    edge = grid.sample(values, torch.tensor([[1.0, 0.0, 1.0]], dtype=DOUBLE)).item()
    assert edge == pytest.approx((values[0, 0, 1:3, 3].sum() + values[0, 1, 1:3, 0].sum()).item() / 4)


def test_the_dice_has_no_breaks() -> None:
    """On the unfolded cube neighbouring pixels of neighbouring faces look almost the same way."""
    size = 16
    dice = cube_to_layout(Cubemap(size).directions.permute(3, 0, 1, 2), "dice")
    assert dice.shape == (3, 3 * size, 4 * size)
    for step in (dice.diff(dim=-1), dice.diff(dim=-2)):
        inside = (dice.norm(dim=0) > 0)[: step.shape[1], : step.shape[2]]
        length = step.norm(dim=0)
        broken = inside & (length > 0.2) & (length < 0.95)  # 1: at the empty places
        assert not broken.any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_positions_are_right_to_a_thousandth_of_a_pixel(dtype: torch.dtype) -> None:
    """A panorama whose values are its own columns and rows tells where each result was read."""
    height, width = 256, 512
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    ramp = torch.stack((columns, rows)).to(dtype)
    focal = 64 / math.tan(math.radians(35))
    camera = PinholeCamera(torch.tensor([focal, focal]), torch.tensor([63.5, 63.5]), (128, 128))
    rotation = some_rotation(5)
    for target, rays in (
        (Cubemap(64), Cubemap(64, dtype=DOUBLE).directions.flatten(0, 2)),
        (camera, camera.to(DOUBLE).unproject(camera.pixel_grid(DOUBLE).flatten(0, 1)).directions),
    ):
        found = resample(ramp, Equirectangular(height, width), target, rotation.to(dtype)).flatten(1).double()
        x, y, z = (rays @ rotation).unbind(-1)
        u = (torch.atan2(x, z) / math.pi + 1) * (width / 2) - 0.5
        v = (0.5 - torch.asin(-y) / math.pi) * height - 0.5
        inside = (u > 0) & (u < width - 1) & (v > 0) & (v < height - 1)  # ramps end at the seam and the poles
        assert inside.double().mean() > 0.9
        error = (found - torch.stack((u, v)))[:, inside].abs().max()
        assert error < (1e-3 if dtype == torch.float32 else 1e-10)
