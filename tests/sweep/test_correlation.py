# SPDX-License-Identifier: Apache-2.0
"""Correlation of cameras against a slow formula that anybody can read, and what must not change it."""

from __future__ import annotations

import math
from itertools import combinations

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.icosphere import Icosphere, icosphere_vertices
from sphericalvision.sweep import SweepTables, correlation_evidence, sphere_sweep
from sphericalvision.sweep.correlation import mean_of_better_half, window_correlations
from sphericalvision.sweep.ring_mean import ids_of_coarser_level, ring_mean
from sphericalvision.sweep.sweep_tables import sweep_tables
from sphericalvision.sweep.visibility import seen_in_view


def windows(level: int) -> list[list[int]]:
    """Each vertex of an icosphere with its neighbours."""
    around = Icosphere(level).neighbors.tolist()
    return [[vertex, *(n for n in ids if n >= 0)] for vertex, ids in enumerate(around)]


def correlation(first: Tensor, last: Tensor, window: list[int], level: int, noise: float) -> float:
    """Zero-mean normalised cross-correlation of colours ``(C, V)``, each vertex less the mean around itself."""
    around = windows(level)
    a, b = (
        torch.stack([values[:, v] - values[:, around[v]].mean(1) for v in window]) for values in (first, last)
    )
    size = len(window)
    scale = math.sqrt(a.square().sum() / size + noise**2) * math.sqrt(b.square().sum() / size + noise**2)
    return float((a * b).sum() / size / scale)


def tables_of(rig: CameraRig, level: int = 2, number: int = 4, feature_level: int = 3) -> SweepTables:
    inverse_depths = torch.linspace(0, 2, number, dtype=torch.float64)
    return sweep_tables(icosphere_vertices(level, torch.float64), inverse_depths, rig, feature_level)


def all_around(cameras: int) -> CameraRig:
    """Cameras that see everything."""
    return ring_rig(cameras, radius=0.1, field_of_view=2 * math.pi).to(torch.float64)


@pytest.mark.parametrize("level", [1, 2])
@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_equals_the_formula(level: int, noise: float, generator: torch.Generator) -> None:
    tables = tables_of(all_around(4))
    images = torch.randn(1, 4, 2, 642, generator=generator, dtype=torch.float64)
    evidence = correlation_evidence(images, tables, level=level, noise=noise)[0]
    values = sphere_sweep(images, tables).values[0]  # (n, C, N, V)
    ids = ids_of_coarser_level(2, level).tolist()
    around = windows(2)
    for hypothesis in (0, 3):
        for vertex in range(0, len(ids), 7):
            window = around[ids[vertex]]
            pairs = [
                correlation(values[a, :, hypothesis], values[b, :, hypothesis], window, 2, noise)
                for a, b in combinations(range(4), 2)
            ]
            mean, best, cameras = evidence[:, hypothesis, vertex].tolist()
            assert mean == pytest.approx(sum(pairs) / 6, abs=1e-9)
            assert best == pytest.approx(sum(max(p, 0) for p in sorted(pairs)[3:]) / 3, abs=1e-9)
            assert cameras == 4


def test_of_a_window_that_a_view_cuts_what_is_left_to_it_counts(generator: torch.Generator) -> None:
    """By loops: sums over what is seen, in the part of the window that is left; for a pair the smaller one."""
    seen = torch.rand(162, 2, 1, generator=generator) > torch.tensor([0.1, 0.5])[:, None]
    colors, around = torch.randn(162, 2, generator=generator) * seen[..., 0], windows(2)
    found = window_correlations(colors[:, :, None, None], seen.float(), 2, 0.1)[0][:, 0]
    local = torch.stack([colors[v] - colors[w].sum(0) / seen[w, :, 0].sum(0) for v, w in enumerate(around)])
    local = local.where(seen[..., 0], 0.0)
    for vertex, window in enumerate(around):
        left = seen[window, :, 0].sum(0)
        if left.min() and len(window) == 7:
            deviations = (local[window].square().sum(0) / left + 0.01).sqrt()
            expected = local[window].prod(1).sum() / left.min() / deviations.prod()
            torch.testing.assert_close(found[vertex], expected, rtol=1e-4, atol=1e-5)


def test_only_pairs_that_see_the_point_count(generator: torch.Generator) -> None:
    tables = tables_of(all_around(3))
    images = torch.randn(1, 3, 1, 642, generator=generator, dtype=torch.float64)
    seen = torch.tensor([True, False, True])[:, None].expand(3, 642)
    some = correlation_evidence(images, tables, seen)
    pair = SweepTables(
        *(table[..., [0, 2], :] if table.ndim == 5 - 1 else table[..., [0, 2]] for table in tables)
    )
    alone = correlation_evidence(images[:, [0, 2]], pair)
    torch.testing.assert_close(some, alone)
    assert (some[:, 2] == 2).all()
    one = correlation_evidence(images, tables, seen & (torch.arange(3)[:, None] == 0))
    assert not one[:, :2].any()
    assert (one[:, 2] == 1).all()


def test_the_number_of_cameras_is_that_of_the_views() -> None:
    rig = ring_rig(4).to(torch.float64)
    tables = tables_of(rig)
    evidence = correlation_evidence(torch.zeros(1, 4, 3, 642, dtype=torch.float64), tables)
    assert evidence[:, 2].equal(tables[2].sum(-1).to(evidence)[None])
    assert not evidence[:, :2].any()  # nothing is told by images without contrast


def test_what_is_interpolated_from_unseen_vertices_is_not_seen(generator: torch.Generator) -> None:
    rig = ring_rig(4).to(torch.float64)
    tables = tables_of(rig, feature_level=4)
    images = torch.randn(1, 4, 3, 2562, generator=generator, dtype=torch.float64)
    view = seen_in_view(rig, 4)
    there, again = (
        correlation_evidence(pictures, tables, view)
        for pictures in (images, images.where(view[:, None], 5.0))
    )
    torch.testing.assert_close(again, there)
    assert there[:, 2].sum() < tables[2].sum()


@pytest.mark.parametrize("length", [1, 2, 3, 6, 10, 15])
def test_better_half_against_sorting(length: int, generator: torch.Generator) -> None:
    values = torch.rand(length, 50, generator=generator)
    count = torch.randint(0, length + 1, (50,), generator=generator)
    absent = torch.arange(length)[:, None] >= count
    found = mean_of_better_half(list(values.masked_fill(absent, -1.0)), count)
    for place, number in enumerate(count.tolist()):
        ordered = sorted(values[:number, place].tolist(), reverse=True)[: math.ceil(number / 2)]
        expected = sum(ordered) / len(ordered) if ordered else 0.0
        assert found[place].item() == pytest.approx(expected, abs=1e-6)


def test_ring_mean_is_the_mean_of_a_vertex_and_its_neighbors(generator: torch.Generator) -> None:
    values = torch.rand(162, 2, 3, generator=generator, dtype=torch.float64)
    mean, coarse = ring_mean(values), ring_mean(values, level=1)
    for vertex, window in enumerate(windows(2)):
        torch.testing.assert_close(mean[vertex], values[window].mean(0))
    assert coarse.equal(mean[ids_of_coarser_level(2, 1)])


def test_coarser_vertices_stay_where_they_are() -> None:
    for coarser in range(4):
        moved = icosphere_vertices(3)[ids_of_coarser_level(3, coarser)]
        torch.testing.assert_close(moved, icosphere_vertices(coarser))
