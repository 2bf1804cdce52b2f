# SPDX-License-Identifier: Apache-2.0
"""The training-free sweep finds depths that are there to be found."""

from __future__ import annotations

import math

import pytest
import torch

from sphericalvision.cameras import ring_rig
from sphericalvision.icosphere import Icosphere
from sphericalvision.sweep import photo_consistency
from sphericalvision.sweep.appearance import local_appearance
from sphericalvision.sweep.photo_consistency import deviation_cost
from sphericalvision.sweep.winner import winner_takes_all
from tests.sweep.textured_sphere import MIN_DEPTH, NUM_HYPOTHESES, sphere_at


@pytest.mark.parametrize("index", [0, 2, 4, 7])
def test_finds_the_radius_of_a_textured_sphere(index: int) -> None:
    rig = ring_rig(4)
    images = sphere_at(index, rig, level=5)
    found, confidence, seen = photo_consistency(images, rig, NUM_HYPOTHESES, MIN_DEPTH)
    assert found.shape == confidence.shape == seen.shape == (1, 642)
    assert seen.all()
    assert ((found - index).abs() <= 1).float().mean() > 0.9
    assert (found == index).float().mean() > 0.75
    noise = photo_consistency(torch.rand(1, 4, 3, 10242), rig, NUM_HYPOTHESES, MIN_DEPTH)
    assert 0 <= noise.confidence.median() < 0.6 < confidence.median() <= 1


def test_exposure_changes_little() -> None:
    rig = ring_rig(4)
    images = sphere_at(4.0, rig, level=5)
    gains = torch.tensor([1.0, 0.7, 0.8, 0.6])[:, None, None]
    found = photo_consistency(images * gains, rig, NUM_HYPOTHESES, MIN_DEPTH).index
    assert ((found - 4).abs() <= 1).float().mean() > 0.8


def test_points_seen_by_fewer_than_two_cameras_are_at_infinity_without_confidence() -> None:
    rig = ring_rig(2, field_of_view=math.radians(150))  # back to back: no point is in both views
    index, confidence, seen = photo_consistency(torch.rand(1, 2, 3, 642), rig, 8, 0.5)
    assert not index.any()
    assert not confidence.any()
    assert not seen.any()


def test_what_is_masked_does_not_count_whatever_is_in_its_place() -> None:
    rig = ring_rig(4)
    images = sphere_at(4.0, rig)
    seen = Icosphere(5).vertices[:, 0] < 0.5
    results = []
    for filling in (0.0, -1.0, 0.7):
        filled = images.where(seen, filling)
        results.append(photo_consistency(filled, rig, NUM_HYPOTHESES, MIN_DEPTH, seen=seen.expand(4, -1)))
    for other in results[1:]:
        for first, second in zip(results[0], other, strict=True):
            assert first.equal(second)
    right = Icosphere(3).vertices[:, 0]
    assert not results[0].seen[0, right > 0.9].any()
    assert results[0].seen[0, right < 0].all()


@pytest.mark.parametrize("cameras", [3, 4, 6])
def test_more_cameras_do_not_disagree_more(cameras: int, generator: torch.Generator) -> None:
    values = torch.randn(1, 6, 1, 20000, generator=generator)
    few = torch.arange(6)[:, None].expand(1, 6, 20000) < 2
    many = torch.arange(6)[:, None].expand(1, 6, 20000) < cameras
    # Of independent noise, whatever the number of cameras: else two would always seem to agree better.
    ratio = deviation_cost(values, many).mean() / deviation_cost(values, few).mean()
    assert ratio == pytest.approx(1, abs=0.02)
    channels = deviation_cost(torch.cat((values, 3 * values), 2), many)
    torch.testing.assert_close(channels, 2 * deviation_cost(values, many))  # the mean of both


def test_local_appearance_by_loops(generator: torch.Generator) -> None:
    """Brightness less its mean and the gradient, by the contrast of what is seen around, and half the colours."""
    grid, images = Icosphere(2, torch.float64), torch.randn(2, 3, 162, generator=generator).double()
    seen = torch.rand(2, 162, generator=generator) > 0.3
    found = local_appearance(images, seen)
    for sample, vertex in ((0, 0), (0, 1), (1, 40), (1, 90), (1, 161)):
        ring = [n for n in grid.neighbors[vertex].tolist() if n >= 0 and seen[sample, n]]
        brightness = images[sample].mean(0)
        steps = brightness[ring] - brightness[vertex]
        mean = steps.sum() / (len(ring) + 1)
        contrast = ((steps - mean).square().sum() / len(ring)).sqrt()
        edges = torch.nn.functional.normalize(grid.vertices[ring] - grid.vertices[vertex], dim=-1)
        relative = torch.cat((-mean[None], 2 * (steps[:, None] * edges).mean(0))) / (contrast + 0.05)
        expected = torch.cat((relative, images[sample, :, vertex] / 2))
        torch.testing.assert_close(found[sample, :, vertex], expected)


def test_winner_takes_all_leaves_out_infinite_costs() -> None:
    cost = torch.tensor([[[torch.inf, torch.inf], [2.0, torch.inf], [1.0, torch.inf]]])
    assert winner_takes_all(cost).tolist() == [[2.0, 0.0]]
