# SPDX-License-Identifier: Apache-2.0
"""The training-free sweep finds depths that are there to be found."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.icosphere import Icosphere
from sphericalvision.sweep import depth_from_index, photo_consistency
from sphericalvision.sweep.cost import local_appearance, winner_takes_all

NUM_HYPOTHESES, MIN_DEPTH = 9, 0.5


def images_of_textured_sphere(rig: CameraRig, depth: float, level: int) -> Tensor:
    """Return what the cameras see inside a textured sphere of radius ``depth`` around the rig."""
    generator = torch.Generator().manual_seed(3)
    waves = 8 * torch.randn(40, 3, generator=generator)
    phases = 2 * math.pi * torch.rand(3, 40, generator=generator)
    rays = Icosphere(level).vertices
    start = rig.positions[:, None] - rig.center
    along = (start * rays).sum(-1)
    reach = -along + (along.square() + depth**2 - start.square().sum(-1)).sqrt()
    points = torch.nn.functional.normalize(start + reach[..., None] * rays, dim=-1)
    colors = ((points @ waves.T)[..., None, :] + phases).sin().mean(-1) * 3
    return colors.clamp(-1, 1).movedim(-1, 1)[None]


@pytest.mark.parametrize("index", [0, 2, 4, 7])
@pytest.mark.parametrize("aggregation", [0, 1])
def test_finds_the_radius_of_a_textured_sphere(index: int, aggregation: int) -> None:
    rig = ring_rig(4)
    depth = depth_from_index(torch.tensor(float(index)), NUM_HYPOTHESES, MIN_DEPTH).item()
    images = images_of_textured_sphere(rig, min(depth, 1e4), level=5)
    found, confidence = photo_consistency(images, rig, NUM_HYPOTHESES, MIN_DEPTH, aggregation=aggregation)
    assert found.shape == confidence.shape == (1, 642)
    assert ((found - index).abs() <= 1).float().mean() > 0.9
    assert (found == index).float().mean() > (0.9 if aggregation else 0.75)
    assert confidence.min() >= 0
    assert confidence.max() <= 1


def test_between_two_hypotheses_the_parabola_is_closer() -> None:
    rig = ring_rig(4)
    depth = depth_from_index(torch.tensor(4.4), NUM_HYPOTHESES, MIN_DEPTH).item()
    images = images_of_textured_sphere(rig, depth, level=5)
    whole, fraction = (
        photo_consistency(images, rig, NUM_HYPOTHESES, MIN_DEPTH, subhypothesis=refine).index
        for refine in (False, True)
    )
    assert (fraction - 4.4).abs().median() < (whole - 4.4).abs().median()


def test_exposure_changes_little() -> None:
    rig = ring_rig(4)
    depth = depth_from_index(torch.tensor(4.0), NUM_HYPOTHESES, MIN_DEPTH).item()
    images = images_of_textured_sphere(rig, depth, level=5)
    gains = torch.tensor([1.0, 0.7, 0.8, 0.6])[:, None, None]
    found = photo_consistency(images * gains, rig, NUM_HYPOTHESES, MIN_DEPTH).index
    assert ((found - 4).abs() <= 1).float().mean() > 0.8


def test_points_seen_by_fewer_than_two_cameras_are_at_infinity_without_confidence() -> None:
    rig = ring_rig(2, field_of_view=math.radians(150))  # back to back: no point is in both views
    index, confidence = photo_consistency(torch.rand(1, 2, 3, 642), rig, 8, 0.5)
    assert not index.any()
    assert not confidence.any()


def test_a_rig_a_sample() -> None:
    rigs = [ring_rig(3), ring_rig(3, radius=0.1)]
    images = torch.rand(2, 3, 3, 642, generator=torch.Generator().manual_seed(0))
    together = photo_consistency(images, CameraRig.stack(rigs), 8, 0.5)
    for sample, rig in enumerate(rigs):
        alone = photo_consistency(images[sample : sample + 1], rig, 8, 0.5)
        torch.testing.assert_close(together.confidence[sample], alone.confidence[0])


def test_local_appearance_ignores_gain_in_its_brightness_channels(generator: torch.Generator) -> None:
    images = torch.randn(1, 3, 642, generator=generator)
    once, twice = local_appearance(10 * images), local_appearance(20 * images)
    torch.testing.assert_close(once[:, :4], twice[:, :4], rtol=0.02, atol=0.2)


def test_local_appearance_gradient_points_uphill() -> None:
    vertices = Icosphere(4).vertices
    up = torch.tensor([0.0, -1.0, 0.0])
    images = (vertices @ up).expand(1, 3, -1)  # brighter upwards
    gradient = local_appearance(images)[0, 1:4].T
    tangent = up - (vertices @ up)[:, None] * vertices
    away_from_poles = tangent.norm(dim=-1) > 0.2
    cosine = torch.nn.functional.cosine_similarity(gradient, tangent, dim=-1)
    assert cosine[away_from_poles].min() > 0.95


def test_winner_takes_all_leaves_out_infinite_costs() -> None:
    cost = torch.tensor([[[torch.inf, torch.inf], [2.0, torch.inf], [1.0, torch.inf]]])
    index, confidence = winner_takes_all(cost, subhypothesis=True)
    assert index.tolist() == [[2.0, 0.0]]
    assert confidence[0].tolist() == pytest.approx([1 / 3, 0])


def test_errors_name_the_argument() -> None:
    rig = ring_rig(2)
    with pytest.raises(ShapeError, match="sphere_images"):
        photo_consistency(torch.zeros(2, 3, 642), rig, 8, 0.5)
    with pytest.raises(ArgumentError, match="level"):
        photo_consistency(torch.zeros(1, 2, 3, 642), rig, 8, 0.5, level=4)
    with pytest.raises(ArgumentError, match="aggregation"):
        photo_consistency(torch.zeros(1, 2, 3, 642), rig, 8, 0.5, aggregation=-1)
