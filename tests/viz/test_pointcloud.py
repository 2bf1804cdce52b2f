# SPDX-License-Identifier: Apache-2.0
"""Point clouds lie where the depth says, and survive the disk."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.sphere import Equirectangular
from sphericalvision.viz import panorama_point_cloud, save_point_cloud


@pytest.mark.parametrize("height", [16, 8])
def test_points_of_a_box_room_lie_on_its_walls(height: int) -> None:
    half = torch.tensor([2.0, 1.2, 4.0])
    directions = Equirectangular.with_square_pixels(height, 32).directions
    depth = (half / directions.abs()).amin(-1)
    points, colors = panorama_point_cloud(depth)
    torch.testing.assert_close((points.abs() / half).amax(-1), torch.ones(height * 32))
    assert colors.shape == points.shape


def test_unknown_infinite_and_far_points_are_left_out_with_their_colours() -> None:
    depth = torch.full((4, 8), 2.0)
    depth[0, :4] = torch.tensor([math.nan, math.inf, 0.0, 50.0])
    colors = torch.arange(32.0).reshape(1, 4, 8).expand(3, 4, 8) / 32
    cloud = panorama_point_cloud(depth, colors, max_depth=10.0, center=torch.tensor([0.0, 0.0, 5.0]))
    assert cloud.colors[:, 0].tolist() == [k / 32 for k in range(4, 32)]
    torch.testing.assert_close(
        (cloud.points - torch.tensor([0.0, 0.0, 5.0])).norm(dim=-1), torch.full((28,), 2.0)
    )


def test_a_saved_cloud_is_read_back(tmp_path: Path, generator: torch.Generator) -> None:
    points, colors = torch.randn(50, 3, generator=generator), torch.rand(50, 3, generator=generator)
    loaded = trimesh.load(save_point_cloud(tmp_path / "cloud.ply", points, colors))
    np.testing.assert_allclose(loaded.vertices, points, atol=1e-6)
    np.testing.assert_allclose(loaded.colors[:, :3] / 255, colors, atol=0.5 / 255 + 1e-6)
    assert [file.name for file in tmp_path.iterdir()] == ["cloud.ply"]


def test_bad_clouds_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ShapeError, match=r"\(n, 3\) both"):
        save_point_cloud(tmp_path / "a.ply", torch.zeros(4, 3), torch.zeros(5, 3))
    with pytest.raises(ArgumentError, match="1 of them not finite"):
        save_point_cloud(tmp_path / "a.ply", torch.tensor([[math.nan, 0.0, 0.0]]), torch.zeros(1, 3))
    with pytest.raises(ShapeError, match=r"colors: expected \(3, 4, 8\)"):
        panorama_point_cloud(torch.ones(4, 8), torch.ones(3, 8, 4))
