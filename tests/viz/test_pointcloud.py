# SPDX-License-Identifier: Apache-2.0
"""Point clouds lie where the depth says, and survive the disk."""

from pathlib import Path

import numpy as np
import torch
import trimesh

from sphericalvision.cameras import CameraRig, FisheyeCamera
from sphericalvision.viz import save_point_cloud
from sphericalvision.viz.pointcloud import point_colors


def test_a_saved_cloud_is_read_back(tmp_path: Path, generator: torch.Generator) -> None:
    points, colors = torch.randn(50, 3, generator=generator), torch.rand(50, 3, generator=generator)
    loaded = trimesh.load(save_point_cloud(tmp_path / "cloud.ply", points, colors))
    np.testing.assert_allclose(loaded.vertices, points, atol=1e-6)
    np.testing.assert_allclose(loaded.colors[:, :3] / 255, colors, atol=0.5 / 255 + 1e-6)
    assert [file.name for file in tmp_path.iterdir()] == ["cloud.ply"]


def test_cameras_count_by_the_eighth_power_of_how_far_forward_they_look() -> None:
    """A point 30° off one camera's axis and 60° off another's, which stand in one place."""
    turn = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    poses = torch.eye(4).repeat(2, 1, 1)
    poses[1, :3, :3] = turn
    lens = FisheyeCamera.from_field_of_view((33, 33), 3.6)
    rig = CameraRig([lens, lens], poses)
    angle = torch.tensor(torch.pi / 6)
    point = 3 * torch.stack((angle.sin(), 0 * angle, angle.cos()))[None]
    images = {"cam1": torch.ones(1, 33, 33), "cam2": torch.zeros(1, 33, 33)}
    first, second = ((1 + cosine) ** 8 for cosine in (angle.cos(), angle.sin()))
    for given in (rig, rig.to(torch.float64)):
        colors, seen = point_colors(given, images, point)
        assert seen.all()
        torch.testing.assert_close(colors[0, 0], first / (first + second))
