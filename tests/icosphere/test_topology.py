# SPDX-License-Identifier: Apache-2.0
"""Counts, orientation and order of the vertices and faces of an icosphere."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from sphericalvision.icosphere import (
    Icosphere,
    icosphere_faces,
    icosphere_neighbors,
    icosphere_vertices,
    level_from_num_vertices,
    num_icosphere_vertices,
)
from sphericalvision.icosphere.subdivision import subdivision_order
from sphericalvision.icosphere.topology import chart_vertex_ids

LEVELS = [0, 1, 2, 4]


@pytest.mark.parametrize("level", [0, 1, 2, 3, 6, 8])
def test_euler_and_unit_length(level: int) -> None:
    ico = Icosphere(level, dtype=torch.float64)
    assert ico.num_vertices == len(ico.vertices) == 2 + 10 * 4**level
    assert len(ico.faces) == 20 * 4**level
    assert torch.equal(ico.faces.unique(), torch.arange(ico.num_vertices))
    torch.testing.assert_close(ico.vertices.norm(dim=-1), torch.ones(ico.num_vertices, dtype=torch.float64))
    assert level_from_num_vertices(ico.num_vertices) == level


@pytest.mark.parametrize("level", LEVELS)
def test_mesh_is_watertight_and_faces_outward(level: int) -> None:
    mesh = trimesh.Trimesh(icosphere_vertices(level), icosphere_faces(level), process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    assert (np.einsum("fc,fc->f", mesh.face_normals, mesh.triangles_center) > 0).all()


@pytest.mark.parametrize("level", LEVELS)
def test_vertices_agree_with_trimesh_subdivision(level: int) -> None:
    """The set of vertices is that of an independent subdivision of the same icosahedron."""
    mesh = trimesh.Trimesh(icosphere_vertices(0, torch.float64), icosphere_faces(0), process=False)
    for _ in range(level):
        mesh = mesh.subdivide()
        mesh.vertices /= np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    assert len(mesh.vertices) == num_icosphere_vertices(level)
    vertices = icosphere_vertices(level, torch.float64)
    distances, index = torch.cdist(
        vertices, torch.from_numpy(np.asarray(mesh.vertices)), compute_mode="donot_use_mm_for_euclid_dist"
    ).min(1)
    assert distances.max() < 1e-12
    assert len(index.unique()) == len(vertices)


def test_convention_vertex_order() -> None:
    """North pole up (-y), south pole down, five charts of 2^(l+1) x 2^l in between; coarser levels are slices."""
    coarse, fine = Icosphere(2, dtype=torch.float64), Icosphere(3, dtype=torch.float64)
    assert fine.vertices[0].tolist() == [0, -1, 0]
    assert fine.vertices[-1].tolist() == [0, 1, 0]
    charts = fine.vertices[1:-1].view(5, 16, 8, 3)
    torch.testing.assert_close(charts[:, 1::2, ::2].reshape(-1, 3), coarse.vertices[1:-1], rtol=0, atol=1e-15)
    assert torch.equal(fine.vertices[fine.coarse_ids], coarse.vertices)
    # The first vertex of the upper ring, at row n - 1 of the first chart, is on the side of +z.
    torch.testing.assert_close(
        charts[0, 7, 0], torch.tensor([0, -(0.2**0.5), 2 * 0.2**0.5], dtype=torch.float64)
    )


@pytest.mark.parametrize("level", LEVELS)
def test_neighbors(level: int) -> None:
    neighbors, vertices = icosphere_neighbors(level), icosphere_vertices(level, torch.float64)
    faces = icosphere_faces(level).tolist()
    expected: list[set[int]] = [set() for _ in vertices]
    for face in faces:
        for vertex in face:
            expected[vertex] |= set(face) - {vertex}
    assert [set(row) - {-1} for row in neighbors.tolist()] == expected  # so that they are each other's
    assert (neighbors == -1).sum() == 12
    assert (neighbors[:, :5] >= 0).all()
    # Counter-clockwise from outside: consecutive neighbours turn positively about the vertex.
    around = vertices[neighbors[:, :5]] - vertices[:, None]
    turn = torch.linalg.cross(around[:, :-1], around[:, 1:]) @ vertices[:, :, None]
    assert (turn > 0).all()


def test_subdivision_order_literals() -> None:
    assert subdivision_order(0).tolist() == [0, 1, 6, 2, 7, 3, 8, 4, 9, 5, 10, 11]
    charts = subdivision_order(1)[1:-1].view(5, 4, 2)
    assert charts[0].tolist() == [[14, 13], [1, 22], [24, 23], [6, 38]]
    assert charts[4].tolist() == [[19, 21], [5, 35], [34, 36], [10, 41]]


@pytest.mark.parametrize("level", LEVELS)
def test_subdivision_order_is_a_permutation(level: int) -> None:
    order = subdivision_order(level)
    assert torch.equal(order.sort().values, torch.arange(num_icosphere_vertices(level)))
    if level > 0:  # plain subdivision keeps the coarse vertices first
        coarse = Icosphere(level).coarse_ids
        assert torch.equal(order[coarse], subdivision_order(level - 1))


def test_golden_vertices_faces_and_charts(golden: Path) -> None:
    tables, unfold = np.load(golden / "icosahedron.npz"), np.load(golden / "unfold.npz")
    for level in range(8):
        ico = Icosphere(level, dtype=torch.float64)
        order = ico.subdivision_order
        expected = torch.from_numpy(tables[f"v{level}"])
        torch.testing.assert_close(expected[order], ico.vertices, rtol=0, atol=1e-12)
        if f"f{level}" in tables.files:
            faces = order[ico.faces].numpy()
            ours, theirs = (
                (
                    np.unique([np.roll(face, -face.argmin()) for face in mesh], axis=0)
                    for mesh in (faces, tables[f"f{level}"])
                )
                if level <= 4
                else (np.sort(np.sort(faces, 1), 0), np.sort(np.sort(tables[f"f{level}"], 1), 0))
            )
            assert np.array_equal(ours, theirs)
        if f"col{level}" in unfold.files:
            assert np.array_equal(order[chart_vertex_ids(level)], unfold[f"col{level}"])
        if f"drop_ne{level}" in unfold.files:
            n = 2**level
            assert np.array_equal(order[1:-1].view(5, 2 * n, n), unfold[f"drop_ne{level}"])
