# SPDX-License-Identifier: Apache-2.0
"""Depth without training: right where it can be known, whatever the order of cameras or the heading of the world."""

from __future__ import annotations

import importlib
import math

import pytest
import torch

from sphericalvision.cameras import ring_rig
from sphericalvision.icosphere import Icosphere
from sphericalvision.sweep import (
    photo_consistency,
    semi_global_costs,
    semi_global_sweep,
    semi_global_tables,
)
from tests.sweep.textured_sphere import MIN_DEPTH, NUM_HYPOTHESES, sphere_at


@pytest.mark.parametrize("index", [0, 2, 4, 7])
def test_the_radius_of_a_textured_sphere_is_found_everywhere(index: int) -> None:
    rig = ring_rig(4)
    images = sphere_at(index, rig)
    found, confidence, seen = semi_global_sweep(images, rig, NUM_HYPOTHESES, MIN_DEPTH)
    assert found.shape == confidence.shape == seen.shape == (1, 642)
    assert (found - index).abs().max() < 1
    assert ((found - index).abs() < 0.5).float().mean() > 0.99
    assert (found - index).abs().mean() < 0.1
    assert confidence.median() > 0.9
    assert confidence.min() >= 0
    assert confidence.max() <= 1


def test_the_winner_is_among_the_hypotheses_that_two_cameras_see(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its colour guides the smoothing; what is not seen costs as much as the only one that is."""
    module, winners = importlib.import_module("sphericalvision.sweep.semi_global"), []
    read = module._colors_at

    def colors_at(
        images: torch.Tensor, shown: torch.Tensor, tables: object, winner: torch.Tensor
    ) -> torch.Tensor:
        winners.append(winner)
        return read(images, shown, tables, winner)

    evidence = torch.zeros(1, 3, 8, 162)
    evidence[:, 1:, 5] = torch.tensor([0.4, 2.0])[None, :, None]
    monkeypatch.setattr(module, "correlation_evidence", lambda *_, **__: evidence)
    monkeypatch.setattr(module, "_colors_at", colors_at)
    tables = semi_global_tables(ring_rig(4), 8, MIN_DEPTH, image_level=3, substeps=1)
    semi_global_costs(torch.rand(1, 4, 3, 642), tables.sweep, tables.seen)
    assert (winners[0] == 5).all()


def test_between_two_hypotheses_the_fraction_is_found() -> None:
    rig = ring_rig(4)
    found = semi_global_sweep(sphere_at(4.3, rig), rig, NUM_HYPOTHESES, MIN_DEPTH).index
    assert (found - 4.3).abs().median() < 0.1


def test_noise_harms_less_than_it_harms_the_smallest_cost_alone() -> None:
    rig = ring_rig(4)
    noise = 0.1 * torch.randn(1, 4, 3, 10242, generator=torch.Generator().manual_seed(0))
    images = sphere_at(4.0, rig) + noise
    simple = photo_consistency(images, rig, NUM_HYPOTHESES, MIN_DEPTH).index
    smooth = semi_global_sweep(images, rig, NUM_HYPOTHESES, MIN_DEPTH).index
    assert (smooth - 4).abs().mean() < 0.5 * (simple - 4).abs().mean()


def test_a_camera_that_sees_something_else_does_no_harm() -> None:
    rig = ring_rig(3, radius=0.1, field_of_view=2 * math.pi)  # all three see everything
    images = sphere_at(5.0, rig)
    images[:, 1] = torch.rand(images[:, 1].shape, generator=torch.Generator().manual_seed(0)) * 2 - 1
    found = semi_global_sweep(images, rig, NUM_HYPOTHESES, MIN_DEPTH).index
    assert ((found - 5).abs() < 1).float().mean() > 0.95


def test_what_is_masked_does_not_count_whatever_is_in_its_place() -> None:
    rig = ring_rig(4)
    images = sphere_at(4.0, rig)
    seen = Icosphere(5).vertices[:, 0] < 0.5  # no camera on the right, so nothing is known there
    results = []
    for filling in (0.0, -1.0, 0.7):
        filled = images.where(seen, filling)
        tables = semi_global_tables(rig, NUM_HYPOTHESES, MIN_DEPTH, image_level=5)
        results.append(semi_global_costs(filled, tables.sweep, seen.expand(4, -1)).evidence)
    for other in results[1:]:
        torch.testing.assert_close(other, results[0])
    found = semi_global_sweep(images, rig, NUM_HYPOTHESES, MIN_DEPTH, seen=seen.expand(1, 4, -1))
    right = Icosphere(3).vertices[:, 0]
    assert not found.seen[0, right > 0.9].any()
    assert not found.confidence[0, right > 0.9].any()
    assert found.seen[0, right < 0].all()
    assert (found.confidence[0, right < 0] > 0.5).float().mean() > 0.95


def test_cameras_that_see_nothing_change_nothing(generator: torch.Generator) -> None:
    rig = ring_rig(4, radius=0.1, field_of_view=2 * math.pi)
    images = torch.rand(1, 4, 3, 642, generator=generator) * 2 - 1
    view = semi_global_tables(rig, 8, 0.5, image_level=3).seen
    seen = torch.tensor([True, False, True, False])[:, None] & view
    kept = [0, 2]  # opposite each other, so that the centre stays
    alone = semi_global_sweep(images[:, kept], rig.subset([rig.names[k] for k in kept]), 8, 0.5)
    together = semi_global_sweep(images, rig, 8, 0.5, seen=seen)
    for value, expected in zip(together, alone, strict=True):
        torch.testing.assert_close(value, expected, atol=1e-4, rtol=0)


def test_gain_and_offset_of_each_camera_leave_the_costs(generator: torch.Generator) -> None:
    tables = semi_global_tables(ring_rig(4).to(torch.float64), 8, 0.5, image_level=3)
    images = torch.rand(1, 4, 3, 642, generator=generator, dtype=torch.float64) * 2 - 1
    gains = torch.tensor([1.0, 0.5, 3.0, 0.1], dtype=torch.float64)[:, None, None]
    offsets = torch.tensor([0.0, 0.3, -0.2, 9.0], dtype=torch.float64)[:, None, None]
    there, again = (
        semi_global_costs(pictures, tables.sweep, tables.seen, noise=0.0).evidence
        for pictures in (images, images * gains + offsets)
    )
    torch.testing.assert_close(again, there)


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_bare_scenes_have_little_confidence(noise: float, generator: torch.Generator) -> None:
    rig = ring_rig(4)
    bare = torch.full((1, 4, 3, 10242), 0.2) + noise * torch.randn(1, 4, 3, 10242, generator=generator)
    clear = semi_global_sweep(sphere_at(4.0, rig), rig, NUM_HYPOTHESES, MIN_DEPTH).confidence
    unclear = semi_global_sweep(bare, rig, NUM_HYPOTHESES, MIN_DEPTH).confidence
    assert unclear.median() < 0.3
    assert clear.median() > 0.9


def test_what_two_cameras_do_not_see_makes_no_edge(generator: torch.Generator) -> None:
    """Images of nearly one colour have no edges, and neither have they where one hypothesis alone is in view."""
    tables = semi_global_tables(ring_rig(4, 0.2), 8, 0.5, image_level=3, substeps=1).sweep
    hidden = (torch.arange(8)[:, None] != 5) & (Icosphere(2).vertices[:, 0] > 0)
    seen = tables.seen & ~hidden[..., None]
    tables = tables._replace(seen=seen, weights=tables.weights * seen.unsqueeze(-1))
    images = 0.5 + 1e-4 * torch.rand(1, 4, 3, 642, generator=generator)
    found, level = (
        semi_global_costs(images, tables, None, 0.01, 0.1, contrast, noise=1e-9).cost
        for contrast in (0.4, 1e9)
    )
    torch.testing.assert_close(found, level, rtol=0, atol=1e-3)


def test_what_two_cameras_do_not_see_takes_the_depth_around_it() -> None:
    rig = ring_rig(4, field_of_view=math.radians(200))  # straight up and down is between the views
    found, confidence, seen = semi_global_sweep(sphere_at(4.0, rig), rig, NUM_HYPOTHESES, MIN_DEPTH, level=4)
    assert not seen.all()
    assert not confidence[~seen].any()
    assert ((found - 4).abs() < 1).all()


def test_has_no_gradient_and_follows_the_dtype() -> None:
    rig = ring_rig(2).to(torch.float64)
    images = torch.rand(1, 2, 3, 162, dtype=torch.float64, requires_grad=True)
    index, confidence, _ = semi_global_sweep(images, rig, 4, 0.5)
    assert not index.requires_grad
    assert index.dtype == confidence.dtype == torch.float64
