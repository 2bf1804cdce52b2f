# SPDX-License-Identifier: Apache-2.0
"""Depth without training: right where it can be known, whatever the order of cameras or the heading of the world."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.data import RotateFivefold
from sphericalvision.icosphere import Icosphere
from sphericalvision.sweep import best_pairs_cost, depth_from_index, photo_consistency, semi_global_sweep
from sphericalvision.sweep.matching import ring_mean

NUM_HYPOTHESES, MIN_DEPTH = 9, 0.5


def textured_sphere(rig: CameraRig, depth: float, level: int = 5) -> Tensor:
    """Images ``(1, n, 3, V)`` from inside a textured sphere of radius ``depth`` around the rig."""
    generator = torch.Generator().manual_seed(3)
    waves = 8 * torch.randn(40, 3, generator=generator)
    phases = 2 * math.pi * torch.rand(3, 40, generator=generator)
    rays = Icosphere(level).vertices
    start = (rig.positions - rig.center)[:, None]
    along = (start * rays).sum(-1)
    reach = -along + (along.square() + depth**2 - start.square().sum(-1)).sqrt()
    points = torch.nn.functional.normalize(start + reach[..., None] * rays, dim=-1)
    colors = ((points @ waves.T)[..., None, :] + phases).sin().mean(-1) * 3
    return colors.clamp(-1, 1).movedim(-1, 1)[None]


@pytest.mark.parametrize("index", [0, 2, 4, 7])
def test_the_radius_of_a_textured_sphere_is_found_everywhere(index: int) -> None:
    rig = ring_rig(4)
    depth = depth_from_index(torch.tensor(float(index)), NUM_HYPOTHESES, MIN_DEPTH).item()
    images = textured_sphere(rig, min(depth, 1e4))
    found, confidence = semi_global_sweep(images, rig, NUM_HYPOTHESES, MIN_DEPTH)
    assert found.shape == confidence.shape == (1, 642)
    assert (found - index).abs().max() < 1
    assert ((found - index).abs() < 0.5).float().mean() > 0.99
    assert (found - index).abs().mean() < 0.1
    assert confidence.median() > 0.9
    assert confidence.min() >= 0
    assert confidence.max() <= 1


def test_between_two_hypotheses_the_fraction_is_found() -> None:
    rig = ring_rig(4)
    depth = depth_from_index(torch.tensor(4.3), NUM_HYPOTHESES, MIN_DEPTH).item()
    found = semi_global_sweep(textured_sphere(rig, depth), rig, NUM_HYPOTHESES, MIN_DEPTH).index
    assert (found - 4.3).abs().median() < 0.1


def test_noise_harms_less_than_it_harms_the_smallest_cost_alone() -> None:
    rig = ring_rig(4)
    depth = depth_from_index(torch.tensor(4.0), NUM_HYPOTHESES, MIN_DEPTH).item()
    noise = 0.1 * torch.randn(1, 4, 3, 10242, generator=torch.Generator().manual_seed(0))
    images = textured_sphere(rig, depth) + noise
    simple = photo_consistency(images, rig, NUM_HYPOTHESES, MIN_DEPTH).index
    smooth = semi_global_sweep(images, rig, NUM_HYPOTHESES, MIN_DEPTH).index
    assert (smooth - 4).abs().mean() < 0.5 * (simple - 4).abs().mean()


def test_exposures_do_not_matter() -> None:
    rig = ring_rig(4)
    depth = depth_from_index(torch.tensor(4.0), NUM_HYPOTHESES, MIN_DEPTH).item()
    gains = torch.tensor([1.0, 0.5, 0.8, 0.4])[:, None, None]
    offsets = torch.tensor([0.0, 0.3, -0.2, 0.1])[:, None, None]
    images = textured_sphere(rig, depth) * gains + offsets
    assert (semi_global_sweep(images, rig, NUM_HYPOTHESES, MIN_DEPTH).index.round() == 4).all()


def test_a_camera_that_sees_something_else_does_no_harm() -> None:
    rig = ring_rig(3, radius=0.1, field_of_view=2 * math.pi)  # all three see everything
    depth = depth_from_index(torch.tensor(5.0), NUM_HYPOTHESES, MIN_DEPTH).item()
    images = textured_sphere(rig, depth)
    images[:, 1] = torch.rand(images[:, 1].shape, generator=torch.Generator().manual_seed(0)) * 2 - 1
    found = semi_global_sweep(images, rig, NUM_HYPOTHESES, MIN_DEPTH).index
    assert ((found - 5).abs() < 1).float().mean() > 0.95


def test_what_is_masked_does_not_count() -> None:
    rig = ring_rig(4)
    depth = depth_from_index(torch.tensor(4.0), NUM_HYPOTHESES, MIN_DEPTH).item()
    images = textured_sphere(rig, depth)
    masked = Icosphere(5).vertices[:, 0] > 0.5  # no camera there, so nothing is known
    images[..., masked] = 0
    _, confidence = semi_global_sweep(images, rig, NUM_HYPOTHESES, MIN_DEPTH)
    directions = Icosphere(3).vertices[:, 0]
    assert (confidence[0, directions > 0.9] == 0).all()
    assert (confidence[0, directions < 0] > 0.5).float().mean() > 0.95


def test_the_order_of_cameras_does_not_matter() -> None:
    rig = ring_rig(4)
    images = torch.rand(1, 4, 3, 642, generator=torch.Generator().manual_seed(0))
    order = [2, 0, 3, 1]
    there = semi_global_sweep(images, rig, 8, 0.5)
    again = semi_global_sweep(images[:, order], rig.subset([rig.names[k] for k in order]), 8, 0.5)
    torch.testing.assert_close(again.confidence, there.confidence, atol=1e-4, rtol=0)
    assert (
        (again.index - there.index).abs() < 1e-3
    ).float().mean() > 0.95  # rounding may decide between equals


def test_turning_the_world_by_a_fifth_turns_the_depth() -> None:
    rig = ring_rig(4)
    images = torch.rand(4, 3, 2562, generator=torch.Generator().manual_seed(0)) * 2 - 1
    index = semi_global_sweep(images[None], rig, 8, 0.5).index[0]
    sample = {"images": images, "inverse_depth": index, "valid": index >= 0, "rig": rig, "frame": ""}
    turned = RotateFivefold(steps=1)(sample)
    found = semi_global_sweep(turned["images"][None], turned["rig"], 8, 0.5).index[0]
    assert ((found - turned["inverse_depth"]).abs() < 0.05).float().mean() > 0.95
    assert (found - index).abs().mean() > 0.2  # it is another picture


def test_points_seen_by_fewer_than_two_cameras_have_no_confidence() -> None:
    rig = ring_rig(2, field_of_view=math.radians(150))  # back to back: no point is in both views
    index, confidence = semi_global_sweep(torch.rand(1, 2, 3, 642), rig, 8, 0.5)
    assert index.isfinite().all()
    assert not confidence.any()


def test_what_two_cameras_do_not_see_takes_the_depth_around_it() -> None:
    rig = ring_rig(4, field_of_view=math.radians(200))  # straight up and down is between the views
    depth = depth_from_index(torch.tensor(4.0), NUM_HYPOTHESES, MIN_DEPTH).item()
    found, confidence = semi_global_sweep(textured_sphere(rig, depth), rig, NUM_HYPOTHESES, MIN_DEPTH)
    assert (confidence == 0).any()
    assert ((found - 4).abs() < 1).all()


def test_a_rig_a_sample() -> None:
    rigs = [ring_rig(3), ring_rig(3, radius=0.1)]
    images = torch.rand(2, 3, 3, 642, generator=torch.Generator().manual_seed(0))
    together = semi_global_sweep(images, CameraRig.stack(rigs), 8, 0.5)
    for sample, rig in enumerate(rigs):
        alone = semi_global_sweep(images[sample : sample + 1], rig, 8, 0.5)
        torch.testing.assert_close(together.index[sample], alone.index[0], atol=1e-3, rtol=0)


def test_has_no_gradient_and_follows_the_dtype() -> None:
    rig = ring_rig(2).to(torch.float64)
    images = torch.rand(1, 2, 3, 162, dtype=torch.float64, requires_grad=True)
    index, confidence = semi_global_sweep(images, rig, 4, 0.5)
    assert not index.requires_grad
    assert index.dtype == confidence.dtype == torch.float64


def test_ring_mean_is_the_mean_of_a_vertex_and_its_neighbors(generator: torch.Generator) -> None:
    values = torch.rand(162, 2, 3, generator=generator, dtype=torch.float64)
    mean = ring_mean(values)
    for vertex, around in enumerate(Icosphere(2).neighbors.tolist()):
        expected = values[[vertex, *(n for n in around if n >= 0)]].mean(0)
        torch.testing.assert_close(mean[vertex], expected)


def test_the_cost_is_one_minus_the_correlation_of_the_best_pair(generator: torch.Generator) -> None:
    values = torch.randn(1, 3, 1, 162, generator=generator, dtype=torch.float64)
    values[:, 2] = 0.5 * values[:, 0] + 0.1 * values[:, 2]
    mask = torch.ones(1, 3, 162, dtype=torch.bool)
    mask[:, 1] = False
    cost = best_pairs_cost(values, mask, rounds=1, noise=0.0)[0]
    around = Icosphere(2).neighbors
    windows = torch.cat((torch.arange(162)[:, None], around), 1)
    local = torch.stack([values[0, :, 0, w[w >= 0]].mean(1) for w in windows], 1)
    rest = values[0, :, 0] - local
    for vertex, window in enumerate(windows):
        first, _, last = rest[:, window[window >= 0]]
        expected = 1 - (first @ last) / (first.norm() * last.norm())
        torch.testing.assert_close(cost[vertex], expected.clamp(0, 1))


def test_the_cost_of_one_camera_is_infinite_and_bare_views_tell_nothing() -> None:
    mask = torch.zeros(1, 2, 42, dtype=torch.bool)
    mask[:, 0] = True
    assert best_pairs_cost(torch.rand(1, 2, 3, 42), mask).isinf().all()
    assert (best_pairs_cost(torch.full((1, 2, 3, 42), 0.3), mask | True) > 0.99).all()


def test_errors_name_the_argument() -> None:
    rig, images = ring_rig(2), torch.zeros(1, 2, 3, 642)
    with pytest.raises(ShapeError, match="sphere_images"):
        semi_global_sweep(images[0], rig, 8, 0.5)
    with pytest.raises(ArgumentError, match="cost_level"):
        semi_global_sweep(images, rig, 8, 0.5, cost_level=4)
    with pytest.raises(ArgumentError, match="substeps"):
        semi_global_sweep(images, rig, 8, 0.5, substeps=0)
    with pytest.raises(ArgumentError, match="P1 <= P2"):
        semi_global_sweep(images, rig, 8, 0.5, small_penalty=5.0)
    with pytest.raises(ShapeError, match="mask"):
        best_pairs_cost(torch.zeros(1, 2, 3, 42), torch.zeros(1, 3, 42, dtype=torch.bool))
