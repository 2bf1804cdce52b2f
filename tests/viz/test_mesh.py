# SPDX-License-Identifier: Apache-2.0
"""Meshes from depth on the icosphere, and point clouds: they lie where the depth says, and survive the disk."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from sphericalvision.cameras import CameraRig, FisheyeCamera
from sphericalvision.icosphere import Icosphere
from sphericalvision.viz import icosphere_mesh, save_point_cloud, sphere_mesh
from sphericalvision.viz.pointcloud import point_colors


def test_constant_depth_is_a_sphere_seen_from_inside() -> None:
    mesh = icosphere_mesh(torch.full((2562,), 2.0))
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(-4 / 3 * math.pi * 8, rel=3e-3)  # inward normals: negative
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=-1), 2.0, atol=1e-6)


def test_it_is_torn_at_jumps_and_unknown_depth() -> None:
    vertices = Icosphere(3).vertices
    depth = torch.where(vertices[:, 2] > 0, 1.0, 5.0)
    mesh = icosphere_mesh(depth, torch.rand(3, 642))
    distances = np.linalg.norm(mesh.vertices[mesh.faces], axis=-1)
    assert np.ptp(distances, axis=-1).max() < 1e-5
    assert mesh.body_count == 2
    depth[vertices[:, 2] > 0] = math.nan
    assert np.linalg.norm(icosphere_mesh(depth).vertices, axis=-1).min() == pytest.approx(5.0)


def test_the_sphere_is_seen_from_outside_and_keeps_the_order_of_vertices(tmp_path: Path) -> None:
    vertices = Icosphere(3).vertices
    mesh = sphere_mesh(vertices[:, 1], radius=2.0)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(4 / 3 * math.pi * 8, rel=0.02)
    np.testing.assert_allclose(mesh.vertices, 2 * vertices.numpy(), atol=1e-6)
    colors = mesh.visual.vertex_colors[:, :3].astype(int)
    np.testing.assert_allclose(colors[0], (68, 1, 84), atol=1)  # the smallest value is viridis' first colour
    np.testing.assert_allclose(colors[-1], (253, 231, 37), atol=1)
    mesh.export(tmp_path / "sphere.ply")
    assert len(trimesh.load(tmp_path / "sphere.ply", process=False).vertices) == 642


def test_colors_of_the_sphere_are_taken_as_they_are() -> None:
    colors = torch.rand(3, 42)
    written = sphere_mesh(colors).visual.vertex_colors[:, :3] / 255
    np.testing.assert_allclose(written, colors.T.numpy(), atol=0.5 / 255 + 1e-6)
    assert sphere_mesh(torch.full((42,), math.nan)).is_watertight


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
