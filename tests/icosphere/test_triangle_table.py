# SPDX-License-Identifier: Apache-2.0
"""The table of triangles against the mesh itself, and walks from wherever they begin."""

import pytest
import torch
import torch.nn.functional as F

from sphericalvision.icosphere import Icosphere
from sphericalvision.icosphere.descent import descend
from sphericalvision.icosphere.fast.triangle_table import (
    coefficients,
    find_in_few_steps,
    find_triangles,
    triangle_table,
)

CPU = torch.device("cpu")


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
