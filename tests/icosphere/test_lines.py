# SPDX-License-Identifier: Apache-2.0
"""Straight lines of the icosphere: every edge once, straight at every vertex, the same after any of its rotations."""

import math

import pytest
import torch
from torch import Tensor

from sphericalvision.icosphere import Icosphere, icosphere_edges, icosphere_neighbors
from sphericalvision.icosphere.lines import icosphere_lines


def steps_of(lines: tuple[Tensor, Tensor]) -> Tensor:
    """Pairs of vertices that follow each other on a line, ``(E, 2)``."""
    loops, edges = lines
    around = torch.stack((loops, loops.roll(-1, 1)), -1).reshape(-1, 2)
    return torch.cat((around, torch.stack((edges[:, :-1], edges[:, 1:]), -1).reshape(-1, 2)))


@pytest.mark.parametrize("level", [0, 1, 2, 4])
def test_every_edge_is_in_exactly_one_line(level: int) -> None:
    steps = {tuple(sorted(pair)) for pair in steps_of(icosphere_lines(level)).tolist()}
    assert len(steps) == len(steps_of(icosphere_lines(level))) == 30 * 4**level
    assert steps == {tuple(sorted(pair)) for pair in icosphere_edges(level).tolist()}


@pytest.mark.parametrize("level", [1, 2, 4])
def test_lines_leave_a_vertex_opposite_to_where_they_come_from(level: int) -> None:
    neighbors = icosphere_neighbors(level)
    loops, edges = icosphere_lines(level)
    triples = [torch.stack((loops.roll(1, 1), loops, loops.roll(-1, 1)), -1).reshape(-1, 3)]
    triples.append(torch.stack((edges[:, :-2], edges[:, 1:-1], edges[:, 2:]), -1).reshape(-1, 3))
    for before, here, after in torch.cat(triples).tolist():
        around = neighbors[here].tolist()
        assert (around.index(before) - around.index(after)) % 6 == 3


def test_edges_of_the_icosahedron_end_at_its_vertices() -> None:
    ends = icosphere_lines(3).edges[:, [0, -1]]
    assert (icosphere_neighbors(3)[ends][..., -1] == -1).all()


@pytest.mark.parametrize("level", [2, 3])
def test_turning_by_a_fifth_takes_lines_to_lines_and_cuts_to_cuts(level: int) -> None:
    ico = Icosphere(level, torch.float64)
    angle = 2 * math.pi / 5
    turn = torch.eye(3, dtype=torch.float64)
    turn[0, 0] = turn[2, 2] = math.cos(angle)
    turn[0, 2], turn[2, 0] = math.sin(angle), -math.sin(angle)
    moved = ico.nearest(ico.vertices @ turn.T)
    loops, _ = icosphere_lines(level)
    fifths = loops.view(-1, 5, 2**level).flatten(0, 1).tolist()
    turned = moved[loops].view(-1, 5, 2**level).flatten(0, 1).tolist()
    backwards = loops.roll(-1, 1).flip(1).view(-1, 5, 2**level).flatten(0, 1)
    known = {tuple(line) for line in fifths} | {tuple(line) for line in backwards.tolist()}
    assert {tuple(line) for line in turned} <= known
