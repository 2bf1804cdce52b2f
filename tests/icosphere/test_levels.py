# SPDX-License-Identifier: Apache-2.0
"""Between levels: parents and children, pooling, interpolation, and the order of plain subdivision."""

import pytest
import torch

from sphericalvision.icosphere import (
    Icosphere,
    IcospherePool,
    IcosphereUpsample,
    from_subdivision_order,
    icosphere_neighbors,
    icosphere_pool,
    icosphere_solid_angles,
    icosphere_upsample,
    icosphere_vertices,
    num_icosphere_vertices,
    to_subdivision_order,
)
from sphericalvision.icosphere.hierarchy import icosphere_vertex_parents
from sphericalvision.icosphere.topology import coarse_vertex_ids

LEVELS = [1, 2, 4]


@pytest.mark.parametrize("level", LEVELS)
def test_a_vertex_halves_the_edge_of_its_parents(level: int) -> None:
    coarse, fine = icosphere_vertices(level - 1, torch.float64), icosphere_vertices(level, torch.float64)
    parents = icosphere_vertex_parents(level)
    middles = torch.nn.functional.normalize(coarse[parents].sum(1), dim=-1)
    torch.testing.assert_close(middles, fine, rtol=0, atol=1e-14)
    kept = coarse_vertex_ids(level)
    assert torch.equal(parents[kept], torch.arange(len(kept))[:, None].expand(-1, 2))
    new = parents[:, 0] != parents[:, 1]
    assert new.sum() == 30 * 4 ** (level - 1)  # one for each edge of the coarser level
    neighbors = icosphere_neighbors(level - 1)
    assert (neighbors[parents[new, 0]] == parents[new, 1:]).any(1).all()


def loop_pool(values: torch.Tensor, level: int, mode: str) -> torch.Tensor:
    """Vertex by vertex, as the docstring says."""
    kept, neighbors = coarse_vertex_ids(level).tolist(), icosphere_neighbors(level).tolist()
    angles = icosphere_solid_angles(level, torch.float64)
    pooled = []
    for vertex in kept:
        around = [v for v in neighbors[vertex] if v >= 0]
        if mode == "max":
            pooled.append(values[..., [vertex, *around]].max(-1).values)
            continue
        weights = torch.cat((angles[[vertex]], angles[around] / 2))
        pooled.append((values[..., [vertex, *around]] * weights).sum(-1) / weights.sum())
    return torch.stack(pooled, -1)


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("mode", ["mean", "max"])
def test_pooling_equals_loops(level: int, mode: str, generator: torch.Generator) -> None:
    values = torch.randn(2, 3, num_icosphere_vertices(level), generator=generator, dtype=torch.float64)
    expected = loop_pool(values, level, mode)
    torch.testing.assert_close(icosphere_pool(values, mode), expected)
    torch.testing.assert_close(IcospherePool(level, mode).double()(values), expected, rtol=1e-6, atol=1e-6)


def test_mean_pooling_keeps_the_integral(generator: torch.Generator) -> None:
    """Weighed by the share of the sphere that each kept vertex gathered, the integral is that of the values."""
    values = torch.randn(642, generator=generator, dtype=torch.float64)
    angles = icosphere_solid_angles(3, torch.float64)
    gathered = torch.zeros(162, dtype=torch.float64)
    gathered.index_add_(0, icosphere_vertex_parents(3).flatten(), (angles / 2).repeat_interleave(2))
    torch.testing.assert_close(gathered @ icosphere_pool(values), angles @ values)
    torch.testing.assert_close(gathered, icosphere_solid_angles(2, torch.float64), rtol=0.03, atol=0)


def test_max_pooling_keeps_integers_and_negative_values() -> None:
    values = -torch.arange(1, 163)
    pooled = icosphere_pool(values, "max")
    assert pooled.dtype == values.dtype
    assert torch.equal(pooled, loop_pool(values, 2, "max"))


@pytest.mark.parametrize("level", [0, 1, 3])
def test_upsampling_is_linear_interpolation(level: int, generator: torch.Generator) -> None:
    coarse = Icosphere(level, torch.float64)
    values = torch.randn(3, coarse.num_vertices, generator=generator, dtype=torch.float64)
    finer = icosphere_upsample(values)
    torch.testing.assert_close(finer, coarse.sample(values, coarse.finer().vertices), rtol=0, atol=1e-12)
    torch.testing.assert_close(IcosphereUpsample(level)(values), finer)
    assert torch.equal(finer[:, coarse.finer().coarse_ids], values)


def test_tables_of_modules_follow_and_are_not_saved() -> None:
    for module in (IcospherePool(2), IcosphereUpsample(2)):
        assert module.state_dict() == {}
        assert module.double()(torch.ones(1, 162, dtype=torch.float64)).dtype == torch.float64
        assert module(torch.ones(1, 162, dtype=torch.float16)).dtype == torch.float16


def test_to_the_subdivision_order_and_back() -> None:
    values = torch.arange(2 * 642).view(2, 642)
    assert torch.equal(from_subdivision_order(to_subdivision_order(values)), values)
    assert torch.equal(to_subdivision_order(from_subdivision_order(values)), values)
    assert torch.equal(values[0, Icosphere(3).subdivision_order], from_subdivision_order(values)[0])
