# SPDX-License-Identifier: Apache-2.0
"""Surface points: normals of planes, nothing in the air, one point a cube, colours of what is seen."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.capture.points import (
    SurfacePoints,
    grid_faces,
    grid_mesh,
    hangs_between,
    surface_normals,
    voxel_means,
)
from sphericalvision.geometry.surfaces import distance_along
from sphericalvision.icosphere import Icosphere
from sphericalvision.sphere import Equirectangular
from tests.worlds import ball

GRIDS = {"icosphere": Icosphere(5), "panorama": Equirectangular(64, 128)}


def wall(rays: torch.Tensor, distance: float = 2.0) -> torch.Tensor:
    """Inverse depth of the planes of a cube around the origin."""
    return rays.abs().amax(-1) / distance


@pytest.mark.parametrize("name", GRIDS)
def test_normals_of_a_cube_are_its_sides(name: str) -> None:
    grid = GRIDS[name]
    rays = grid.directions.reshape(-1, 3)
    sides = rays.abs()
    inside = sides.amax(-1) > 1.2 * sides.topk(2).values[:, 1]  # not at an edge of the cube
    inside &= rays[:, 1].abs() < 0.99  # at the poles of a panorama triangles have no size
    normals = surface_normals(rays / wall(rays)[:, None], grid_faces(grid))
    expected = -torch.nn.functional.one_hot(sides.argmax(-1), 3) * rays.sign()
    assert (normals * expected).sum(-1)[inside].min() > 0.999
    assert not hangs_between(wall(rays), rays, grid_faces(grid)).any()


@pytest.mark.parametrize("name", GRIDS)
def test_what_an_edge_leaves_in_the_air_is_cut_and_floors_are_not(name: str) -> None:
    """A ball before a wall, its rim smeared over one or two steps of the grid; a floor out to ten times its height."""
    grid = GRIDS[name]
    rays = grid.directions.reshape(-1, 3)
    angle = torch.atan2(rays[:, :2].norm(dim=-1), rays[:, 2])
    width = 0.08
    share = ((0.5 - angle) / width + 0.5).clamp(0, 1)
    smeared = share * 1.0 + (1 - share) * 0.1  # 1 m and 10 m
    hanging = hangs_between(smeared, rays, grid_faces(grid))
    clean = (share == 0) | (share == 1)
    assert not hanging[clean].any()
    middle = (share > 0.15) & (share < 0.85)
    assert hanging[middle].float().mean() > 0.5
    floor = rays[:, 1].clamp(min=0.1)  # 1 m below
    assert not hangs_between(floor, rays, grid_faces(grid))[rays[:, 1] > 0.15].any()


@pytest.mark.parametrize("name", GRIDS)
def test_a_mesh_is_the_surface_cut_where_it_jumps(name: str) -> None:
    """A cube around the rig without a hole; a ball before it is cut free, and all triangles face the rig."""
    grid, rig = GRIDS[name], ring_rig(3, image_size=(32, 32))
    rays = grid.directions.reshape(-1, 3)
    images = {camera: torch.rand(3, 32, 32) for camera in rig.names}
    everything = torch.ones(len(rays), dtype=torch.bool)
    cube = grid_mesh(grid, wall(rays), everything, rig, images)
    assert len(cube.faces) == len(grid_faces(grid))
    farthest = torch.from_numpy(cube.vertices).abs().amax(-1)
    torch.testing.assert_close(farthest, torch.full((len(rays),), 2.0).double())
    to_rig = -cube.triangles_center
    assert (np.einsum("ij,ij->i", cube.face_normals, to_rig)[cube.area_faces > 1e-9] > 0).all()
    ball = rays[:, 2] > 0.95
    jumping = grid_mesh(grid, torch.where(ball, 2.0, wall(rays)), everything, rig, images)
    lengths = np.linalg.norm(jumping.vertices[jumping.edges_unique], axis=-1)
    assert (np.ptp(lengths, axis=1) < 0.6).all()  # no triangle from the ball's half a metre to the walls
    assert len(jumping.split(only_watertight=False)) == 2
    half = grid_mesh(grid, wall(rays), rays[:, 0] > 0, rig, images)
    assert half.vertices[:, 0].min() > 0


def test_points_are_the_surface_around_the_rig() -> None:
    rig = ring_rig(3, image_size=(16, 16))
    poses = rig.world_from_camera.clone()
    poses[:, :3, 3] += 1
    rig = CameraRig(rig.cameras, poses)
    cloud = ball(rig, confidence=0.7).points()
    relative = cloud.points - rig.center
    torch.testing.assert_close(relative.norm(dim=-1), torch.full((len(relative),), 2.0), rtol=1e-5, atol=0)
    assert ((cloud.normals * relative).sum(-1) < -1.99).all()
    assert len(cloud.points) == len(cloud.colors) == len(cloud.confidence) == Icosphere(4).num_vertices


def test_points_are_kept_by_confidence_distance_and_sight() -> None:
    rig = ring_rig(3, image_size=(16, 16))
    depth = ball(rig, confidence=0.7)
    assert not len(depth.points(min_confidence=0.8).points)
    assert not len(depth.points(max_depth=1.9).points)
    assert len(depth.points(min_confidence=0.6, max_depth=2.1).points) == len(depth.index)
    forward = ring_rig(2, image_size=(16, 16), field_of_view=math.radians(120)).subset([0])
    points = ball(forward, confidence=0.7).points().points - forward.center
    assert 0 < len(points) < len(depth.index)
    assert (torch.atan2(points[:, :2].norm(dim=1), points[:, 2]) < math.radians(61)).all()


def test_the_share_seen_is_of_the_sphere_and_infinity_is_no_point() -> None:
    """Half a hypothesis away from infinity is as far as any."""
    depth = ball(ring_rig(3, image_size=(16, 16)))
    down = depth.directions[:, 1]
    assert replace(depth, seen=down > 0.5).share_seen == pytest.approx(0.25, abs=0.01)
    assert depth.max_depth == pytest.approx(14.0, rel=1e-4)  # of 8 hypotheses from 1 m on
    far = replace(depth, index=torch.where(down > 0, 0.51, 0.49))
    assert len(far.points().points) == (down > 0).sum()


def test_a_voxel_larger_than_all_is_asked_about() -> None:
    points = torch.randn(20, 3, generator=torch.Generator().manual_seed(1))
    with pytest.warns(UserWarning, match="voxel: .*50 m"):
        assert len(voxel_means(SurfacePoints(points, points, points, points[:, 0]), 50.0).points) <= 8


def test_a_voxel_keeps_one_point() -> None:
    rig = ring_rig(3, image_size=(16, 16))
    depth = ball(rig, confidence=0.7)
    cloud = depth.points(voxel=0.5)
    cubes = (depth.points().points / 0.5).floor().unique(dim=0)
    assert len(cloud.points) == len(cubes) < len(depth.index)
    torch.testing.assert_close(cloud.normals.norm(dim=-1), torch.ones(len(cloud.points)))
    assert cloud.points.norm(dim=-1).min() > 1.7


def test_triangles_across_an_edge_of_depth_hardly_turn_normals() -> None:
    """A wall that ends before one three times as far: normals at its edge are the wall's within some degrees."""
    grid = GRIDS["icosphere"]
    rays = grid.directions[grid.directions[:, 2] > 0.7]
    ids = torch.full((grid.num_vertices,), -1)
    ids[grid.directions[:, 2] > 0.7] = torch.arange(len(rays))
    faces = ids[grid.faces]
    faces = faces[(faces >= 0).all(1)]
    near = rays[:, 0] < 0
    points = rays / rays[:, 2:] * torch.where(near, 1.0, 3.0)[:, None]
    mixed = faces[near[faces].any(1) & ~near[faces].all(1)]
    edge = torch.zeros(len(rays), dtype=torch.bool).index_fill_(0, mixed.flatten(), True) & near
    inside = edge & (rays[:, 2] > 0.75)
    assert inside.sum() > 20
    assert surface_normals(points, faces)[inside, 2].max() < -0.99


def test_a_ray_from_off_the_centre_meets_what_is_nearer_to_it_than_the_nearest_depth() -> None:
    """Something narrow at 1 m around the centre, 0.6 to 0.7 m from where the ray begins; all else is 20 m away."""
    start, ray = torch.tensor([0.0, 0.0, 0.5]), torch.tensor([[1.0, 0.0, 1.0]]) / math.sqrt(2)
    ends = [torch.atan2(p[0], p[2]) for p in (start + d * ray[0] for d in (0.6, 0.7))]

    def surface(rays: torch.Tensor) -> torch.Tensor:
        angle = torch.atan2(rays[:, 0], rays[:, 2])
        return torch.where((angle > ends[0]) & (angle < ends[1]), 1.0, 0.05)

    assert 0.59 < distance_along(ray, start, surface, min_depth=1.0) < 0.71


def test_a_ray_that_begins_behind_the_surface_meets_nothing_before_it_is_in_front() -> None:
    """Outside of a ball of 2 m: rays away from it, and through it to its other side."""
    start = torch.tensor([0.0, 0.0, -2.2])
    rays = torch.tensor([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    distance = distance_along(rays, start, lambda rays: torch.full_like(rays[:, 0], 0.5), min_depth=1.0)
    assert distance[:2].isnan().all()
    assert distance[2].item() == pytest.approx(4.2, rel=1e-3)
