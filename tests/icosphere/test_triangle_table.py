# SPDX-License-Identifier: Apache-2.0
"""The table of triangles against the mesh itself, and walks from wherever they begin."""

import pytest
import torch
import torch.nn.functional as F

from sphericalvision.icosphere import Icosphere
from sphericalvision.icosphere.descent import descend
from sphericalvision.icosphere.fast.octahedron import cell_centers, cell_numbers
from sphericalvision.icosphere.fast.triangle_table import (
    coefficients,
    find_in_few_steps,
    find_triangles,
    triangle_table,
)

CPU = torch.device("cpu")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("level", [0, 2, 6])
def test_coefficients_rebuild_directions_from_rays_of_any_length(
    level: int, dtype: torch.dtype, generator: torch.Generator
) -> None:
    table = triangle_table(level, dtype, CPU)
    rays = torch.randn(3, 500, dtype=torch.float64, generator=generator).to(dtype)
    rays *= torch.logspace(-9, 9, 500, dtype=dtype)
    triangles, shares = find_triangles(rays, table)
    corners = Icosphere(level, torch.float64).vertices[table.ids[triangles]]
    rebuilt = F.normalize(torch.einsum("mki,km->im", corners, shares.double()), dim=0)
    eps = torch.finfo(dtype).eps
    torch.testing.assert_close(rebuilt, F.normalize(rays.double(), dim=0), rtol=0, atol=8 * eps)
    # Planes cut the sphere
    torch.testing.assert_close(shares.sum(0), rays.norm(dim=0), rtol=0.3 / 2**level, atol=0)
    assert (shares.amin(0) >= -16 * eps * 2**level * shares.sum(0)).all()


@pytest.mark.parametrize("level", [0, 1, 2, 3, 5, 7])
def test_cells_know_the_triangle_in_their_middle(level: int) -> None:
    table = triangle_table(level, torch.float32, CPU)
    centers = cell_centers(table.resolution)
    assert len(table.cells) == centers.shape[1] == 2 * table.resolution**2
    shares = coefficients(centers, table.cells, table)
    assert (shares.amin(0) >= -16 * 2**level * torch.finfo(torch.float32).eps * shares.sum(0)).all()


@pytest.mark.parametrize("level", [1, 6, 8])
def test_as_many_steps_for_any_rays_end_in_their_triangles(level: int, generator: torch.Generator) -> None:
    """At a level as fine as the last one, too, where there are fewer cells for a triangle; and at corners."""
    table = triangle_table(level, torch.float32, CPU)
    rays = torch.cat(
        (torch.randn(3, 300_000, generator=generator), 3 * Icosphere(min(level, 4)).vertices.T), 1
    )
    triangles, weights = find_in_few_steps(rays, table)
    shares = coefficients(rays, triangles, table)
    assert (shares.amin(0) >= -16 * 2**level * torch.finfo(torch.float32).eps * shares.sum(0)).all()
    torch.testing.assert_close(weights, (shares / shares.sum(0)).clamp(min=0), rtol=0, atol=5e-4)


@pytest.mark.parametrize("steps", [0, 2, 200])
def test_walks_end_in_the_same_triangle_wherever_they_begin(
    steps: int, generator: torch.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Steps across edges lead there; where they are not enough, the way down does."""
    monkeypatch.setattr("sphericalvision.icosphere.fast.triangle_table.STEPS", steps)
    level = 3
    table = triangle_table(level, torch.float64, CPU)
    rays = torch.randn(3, 1000, dtype=torch.float64, generator=generator)
    guess = torch.randint(len(table.ids), (1000,), dtype=torch.int32, generator=generator)
    triangles, shares = find_triangles(rays, table, guess)
    expected = descend(F.normalize(rays.T, dim=-1), level)
    assert torch.equal(triangles.long(), expected.numbers(level))
    assert torch.equal(table.ids[triangles], expected.vertex_ids(level))
    torch.testing.assert_close(shares, coefficients(rays, triangles, table))


@pytest.mark.parametrize("resolution", [1, 2, 7, 64])
def test_cells_cover_the_sphere_once(resolution: int, generator: torch.Generator) -> None:
    numbers = torch.arange(2 * resolution**2, dtype=torch.int32)
    assert torch.equal(cell_numbers(cell_centers(resolution), resolution), numbers)
    rays = torch.randn(3, 10000, generator=generator)
    found = cell_numbers(rays, resolution)
    assert torch.equal(found, cell_numbers(8 * rays, resolution))
    # A ray lies within half a cell of the middle of its own, in the coordinates of the octahedron.
    both = torch.stack((rays, cell_centers(resolution)[:, found.long()]))
    x, y, z = (both / both.abs().sum(1, keepdim=True)).unbind(1)
    for across in (x + z, x - z):
        assert ((across[0] - across[1]).abs() <= 1 / resolution + 1e-6).all()
    assert (y[0] * y[1] >= 0).all()
