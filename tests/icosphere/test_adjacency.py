# SPDX-License-Identifier: Apache-2.0
"""Edges, faces across edges, rings and discs, against sets built in plain loops."""

import math
from collections import defaultdict

import numpy as np
import pytest
import torch
import trimesh

from sphericalvision.icosphere import (
    Icosphere,
    icosphere_edges,
    icosphere_faces,
    icosphere_neighbors,
    icosphere_rings,
    icosphere_vertices,
    icosphere_within,
    num_icosphere_vertices,
)
from sphericalvision.icosphere.adjacency import icosphere_face_neighbors

LEVELS = [0, 1, 2, 4]


@pytest.mark.parametrize("level", LEVELS)
def test_edges_are_those_of_the_mesh(level: int) -> None:
    mesh = trimesh.Trimesh(icosphere_vertices(level), icosphere_faces(level), process=False)
    expected = {tuple(edge) for edge in np.sort(mesh.edges_unique, 1).tolist()}
    assert {tuple(edge) for edge in icosphere_edges(level).sort(1).values.tolist()} == expected
    assert len(icosphere_edges(level)) == len(expected) == 30 * 4**level


def test_an_edge_is_found_at_its_owner() -> None:
    edges = icosphere_edges(3)
    assert torch.equal(edges[:, 0], torch.arange(1, num_icosphere_vertices(3) - 1).repeat_interleave(3))


@pytest.mark.parametrize("level", LEVELS)
def test_faces_across_edges(level: int) -> None:
    faces = icosphere_faces(level).tolist()
    by_edge: dict[frozenset[int], list[int]] = defaultdict(list)
    for number, (a, b, c) in enumerate(faces):
        for edge in ((a, b), (b, c), (c, a)):
            by_edge[frozenset(edge)].append(number)
    across = icosphere_face_neighbors(level).tolist()
    for number, (a, b, c) in enumerate(faces):
        for k, edge in enumerate(((a, b), (b, c), (c, a))):
            assert sorted([number, across[number][k]]) == by_edge[frozenset(edge)]


def rings_by_breadth_first_search(level: int, center: int, num_rings: int) -> list[set[int]]:
    neighbors = icosphere_neighbors(level).tolist()
    rings, known = [{center}], {center}
    for _ in range(num_rings):
        rings.append({w for v in rings[-1] for w in neighbors[v] if w >= 0} - known)
        known |= rings[-1]
    return rings


@pytest.mark.parametrize(("level", "num_rings"), [(0, 0), (0, 4), (1, 5), (2, 1), (3, 3)])
def test_rings_equal_breadth_first_search(level: int, num_rings: int) -> None:
    """Also where the rings have gone all the way round the sphere."""
    ids = icosphere_rings(level, num_rings)
    assert ids.shape == (num_icosphere_vertices(level), 1 + 3 * num_rings * (num_rings + 1))
    widths = [1, *(6 * ring for ring in range(1, num_rings + 1))]
    for center in range(0, len(ids), 1 + len(ids) // 60):
        expected = rings_by_breadth_first_search(level, center, num_rings)
        for columns, ring in zip(ids[center].split(widths), expected, strict=True):
            inside = columns[columns >= 0].tolist()
            assert inside == sorted(ring)
            assert (columns[len(inside) :] == -1).all()


def test_rings_of_some_centers_are_rows_of_all() -> None:
    centers = torch.tensor([5, 0, 641])
    assert torch.equal(icosphere_rings(3, 2, centers), icosphere_rings(3, 2)[centers])


@pytest.mark.parametrize("angle", [0.0, 1e-4, 0.3, math.pi / 2, 3.0, math.pi])
def test_discs_equal_angles_in_float64(angle: float, generator: torch.Generator) -> None:
    directions = torch.randn(2, 5, 3, generator=generator, dtype=torch.float64)
    directions[0, 0] = 3 * icosphere_vertices(3, torch.float64)[100]  # of any length
    vertices = icosphere_vertices(3, torch.float64)
    unit = directions / directions.norm(dim=-1, keepdim=True)
    sine = torch.linalg.cross(unit[..., None, :].expand(2, 5, 642, 3), vertices.expand(2, 5, 642, 3)).norm(
        dim=-1
    )
    angles = torch.atan2(sine, unit @ vertices.T)
    inside = icosphere_within(directions, angle, level=3)
    clear = (angles - angle).abs() > 1e-12  # on the border either answer is right
    assert inside.shape == (2, 5, 642)
    assert torch.equal(inside[clear], (angles <= angle)[clear])
    assert inside[0, 0, 100]


def test_the_smallest_discs_in_float32_hold_their_center() -> None:
    vertices = icosphere_vertices(6)
    inside = icosphere_within(vertices[::1000], 1e-3, level=6)
    assert torch.equal(inside.nonzero()[:, 1], torch.arange(0, len(vertices), 1000))


def test_the_module_has_the_same_tables() -> None:
    ico = Icosphere(2)
    assert torch.equal(ico.edges, icosphere_edges(2))
    assert (ico.finer().level, ico.coarser().level) == (3, 1)
    assert ico.double().finer().vertices.dtype == torch.float64
