# SPDX-License-Identifier: Apache-2.0
"""Solid angles of faces, vertices and Voronoi cells, and normals, against Girard's theorem, counting and trimesh."""

import math

import numpy as np
import pytest
import torch
import trimesh

from sphericalvision.icosphere import (
    icosphere_faces,
    icosphere_normals,
    icosphere_solid_angles,
    icosphere_vertices,
    icosphere_voronoi_solid_angles,
)
from sphericalvision.icosphere.areas import icosphere_face_solid_angles


@pytest.mark.parametrize("level", [0, 1, 3, 6])
def test_all_areas_sum_to_the_sphere(level: int) -> None:
    for function in (icosphere_face_solid_angles, icosphere_solid_angles, icosphere_voronoi_solid_angles):
        areas = function(level, torch.float64)
        assert areas.min() > 0
        assert areas.sum().item() == pytest.approx(4 * math.pi, rel=1e-12)


def test_faces_have_the_angle_excess_of_girard() -> None:
    corners = icosphere_vertices(3, torch.float64)[icosphere_faces(3)]
    excess = torch.full((len(corners),), -math.pi, dtype=torch.float64)
    for k in range(3):
        a, b, c = (corners[:, (k + j) % 3] for j in range(3))
        first, second = torch.linalg.cross(a, b), torch.linalg.cross(a, c)
        excess += torch.atan2(torch.linalg.cross(first, second).norm(dim=-1), (first * second).sum(-1))
    torch.testing.assert_close(icosphere_face_solid_angles(3, torch.float64), excess, rtol=1e-9, atol=0)


def test_voronoi_cells_hold_their_share_of_directions(generator: torch.Generator) -> None:
    """Directions spread evenly fall into each cell as often as its area says; brute force finds the nearest."""
    directions = torch.nn.functional.normalize(
        torch.randn(400_000, 3, generator=generator, dtype=torch.float64), dim=-1
    )
    vertices = icosphere_vertices(1, torch.float64)
    counts = (directions @ vertices.T).argmax(-1).bincount(minlength=42)
    expected = 400_000 * icosphere_voronoi_solid_angles(1, torch.float64) / (4 * math.pi)
    assert ((counts - expected).abs() < 5 * expected.sqrt()).all()  # five standard deviations


def test_areas_of_the_icosahedron_are_equal() -> None:
    for function in (icosphere_solid_angles, icosphere_voronoi_solid_angles):
        torch.testing.assert_close(
            function(0, torch.float64), torch.full((12,), math.pi / 3, dtype=torch.float64)
        )


def test_normals_equal_those_of_trimesh(generator: torch.Generator) -> None:
    depth = 1 + 0.2 * torch.rand(162, 1, generator=generator, dtype=torch.float64)
    points, faces = depth * icosphere_vertices(2, torch.float64), icosphere_faces(2)
    mesh = trimesh.Trimesh(points, faces, process=False)
    expected = np.zeros((162, 3))
    for normal, area, corners in zip(mesh.face_normals, mesh.area_faces, faces.tolist(), strict=True):
        expected[corners] += area * normal
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    torch.testing.assert_close(icosphere_normals(points), torch.from_numpy(expected))


def test_points_at_infinity_leave_their_triangles_out() -> None:
    points = icosphere_vertices(0, torch.float64).clone()
    points[0] = torch.inf
    normals = icosphere_normals(points)
    assert normals.isfinite().all()
    assert (normals[0] == 0).all()  # no triangle is left
    torch.testing.assert_close(normals[-1], points[-1])  # far away nothing changes
