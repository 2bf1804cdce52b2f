# SPDX-License-Identifier: Apache-2.0
"""Semi-global smoothing against plain loops over walks on the neighbours, and what must not change it."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from torch import Tensor

from sphericalvision.icosphere import Icosphere, icosphere_neighbors
from sphericalvision.sweep import semi_global_smoothing
from sphericalvision.sweep.smoothing import smoothing_paths


def walk_back(neighbors: list[list[int]], vertex: int, towards: int, steps: int) -> list[int]:
    """Vertices of the straight walk from ``vertex`` to its neighbour ``towards`` and on, until it ends."""
    walk = [vertex, towards]
    while len(walk) <= steps and neighbors[walk[-1]][5] >= 0:
        around = neighbors[walk[-1]]
        walk.append(around[(around.index(walk[-2]) + 3) % 6])
    return walk


def smoothed_by_loops(
    cost: list[list[float]],
    color: list[float],
    small: float,
    large: float,
    contrast: float,
    walks: list[list[int]],
) -> list[float]:
    """Mean over walks (away from a vertex) of the path cost at their first vertex; cost by hypothesis and vertex."""
    number = len(cost)
    total = [0.0] * number
    for walk in walks:
        path = walk[::-1]
        reached = [cost[i][path[0]] for i in range(number)]
        for before, here in itertools.pairwise(path):
            jump = max(small, large / (1 + abs(color[here] - color[before]) / contrast))
            best = min(reached)
            step = []
            for i in range(number):
                ways = [reached[i], best + jump]
                ways += [reached[j] + small for j in (i - 1, i + 1) if 0 <= j < number]
                step.append(cost[i][here] + min(ways) - best)
            reached = step
        total = [a + b for a, b in zip(total, reached, strict=True)]
    return [value / len(walks) for value in total]


def walks_to(vertex: int, level: int, paths: list[tuple[Tensor, int]]) -> list[list[int]]:
    """The walks away from a vertex that are as long as the paths which bring results to it."""
    neighbors = icosphere_neighbors(level).tolist()
    walks = []
    for towards in (n for n in neighbors[vertex] if n >= 0):
        lengths = []
        for ids, first in paths:
            steps, columns = torch.where(ids[first:] == vertex)
            for step, column in zip((steps + first).tolist(), columns.tolist(), strict=True):
                if ids[step - 1, column] == towards:
                    lengths.append(step)
        assert len(lengths) == 1  # exactly one path comes from each neighbour
        walks.append(walk_back(neighbors, vertex, towards, lengths[0]))
        assert len(walks[-1]) == lengths[0] + 1
    return walks


@pytest.mark.parametrize("level", [0, 1, 2])
def test_equals_plain_loops_over_straight_walks(level: int, generator: torch.Generator) -> None:
    count = Icosphere(level).num_vertices
    cost = torch.rand(1, 5, count, generator=generator, dtype=torch.float64)
    guide = torch.rand(1, 1, count, generator=generator, dtype=torch.float64)
    found = semi_global_smoothing(cost, 0.1, 0.7, guide, contrast=0.3)[0]
    paths = smoothing_paths(level, torch.device("cpu"))
    kinds = []
    for kind in paths.kinds:
        wait = int((paths.begun[:, kind] == 0).all(1).sum())
        kinds.append((paths.ids[wait:, kind], paths.first - wait))
    table, color = cost[0].tolist(), guide[0, 0].tolist()
    for vertex in range(count):
        expected = smoothed_by_loops(table, color, 0.1, 0.7, 0.3, walks_to(vertex, level, kinds))
        assert found[:, vertex].tolist() == pytest.approx(expected, rel=1e-12)


def test_without_penalties_nothing_is_smoothed(generator: torch.Generator) -> None:
    cost = torch.rand(2, 4, 162, generator=generator)
    torch.testing.assert_close(semi_global_smoothing(cost, 0.0, 0.0), cost)


def test_a_hypothesis_alone_keeps_its_cost(generator: torch.Generator) -> None:
    cost = torch.rand(1, 1, 162, generator=generator)
    torch.testing.assert_close(semi_global_smoothing(cost, 0.1, 0.5), cost)


def test_turning_by_a_fifth_turns_the_result(generator: torch.Generator) -> None:
    ico = Icosphere(3, torch.float64)
    cost = torch.rand(1, 6, ico.num_vertices, generator=generator, dtype=torch.float64)
    guide = torch.rand(1, 3, ico.num_vertices, generator=generator, dtype=torch.float64)
    smooth = semi_global_smoothing(cost, 0.1, 0.8, guide)
    angle = 2 * math.pi / 5
    axis = torch.tensor([math.sin(angle), 0.0, math.cos(angle)], dtype=torch.float64)
    turn = torch.stack((axis[[2, 1, 0]] * torch.tensor([1.0, 1, -1]), torch.tensor([0.0, 1, 0]), axis))
    moved = ico.nearest(ico.vertices @ turn.to(torch.float64))
    assert moved.sort().values.equal(torch.arange(len(moved)))
    turned = semi_global_smoothing(cost[..., moved], 0.1, 0.8, guide[..., moved])
    torch.testing.assert_close(turned, smooth[..., moved])


def test_paths_to_and_fro_along_a_line_begin_at_the_same_vertices() -> None:
    paths = smoothing_paths(3, torch.device("cpu"))
    forwards, backwards = (set(ids.tolist()) for ids in paths.ids[paths.first, paths.kinds[0]].chunk(2))
    assert forwards == backwards


def test_a_bare_region_takes_the_depth_around_it() -> None:
    ico = Icosphere(4)
    cost = torch.ones(1, 9, ico.num_vertices)
    cost[:, 6] = 0.0
    bare = ico.vertices[:, 2] > 0.95
    cost[:, :, bare] = 1.0
    assert (semi_global_smoothing(cost, 0.2, 1.0).argmin(1) == 6).all()


def test_an_edge_of_the_guide_makes_jumps_cheap() -> None:
    ico = Icosphere(4)
    right = ico.vertices[:, 0] > 0.01
    cost = torch.full((1, 9, ico.num_vertices), 0.5)
    cost[:, 2, ~right] = 0.3  # a weak difference, which a large penalty would smooth away
    cost[:, 7, right] = 0.0
    guide = right.float()[None, None]
    wrong = [
        (semi_global_smoothing(cost, 0.2, 3.0, colors, contrast=0.05).argmin(1)[0, ~right] != 2).sum()
        for colors in (None, guide)
    ]
    assert wrong[1] < 0.5 * wrong[0]
