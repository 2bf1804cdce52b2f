# SPDX-License-Identifier: Apache-2.0
"""Photo-consistency of a depth map is greatest where the cameras agree: at the true depth."""

from __future__ import annotations

import torch

from sphericalvision.cameras import ring_rig
from sphericalvision.sweep import photo_consistency, photo_consistency_share
from sphericalvision.sweep.consistency_share import consistency_share
from sphericalvision.sweep.semi_global import semi_global_tables
from tests.sweep.textured_sphere import MIN_DEPTH, NUM_HYPOTHESES, sphere_at

RIG = ring_rig(4)


def share_at(index: float, images: torch.Tensor) -> float:
    estimate = torch.full((1, 642), index)
    return photo_consistency_share(estimate, images, RIG, NUM_HYPOTHESES, MIN_DEPTH).item()


def test_the_true_depth_is_the_most_consistent() -> None:
    images = sphere_at(4.0, RIG, level=4)
    at_truth = share_at(4.0, images)
    assert 0.9 < at_truth <= 1
    assert all(share_at(index, images) < at_truth - 0.05 for index in (3.0, 5.0, 7.5))


def test_tables_stand_for_the_rig_and_levels_may_differ() -> None:
    images = sphere_at(4.0, RIG, level=4)
    tables = semi_global_tables(RIG, NUM_HYPOTHESES, MIN_DEPTH, image_level=4)
    index = torch.full((1, 2562), 4.0)
    alone = photo_consistency_share(index[:, :642], images, RIG, NUM_HYPOTHESES, MIN_DEPTH)
    kept = photo_consistency_share(index, images, tables, NUM_HYPOTHESES, MIN_DEPTH)
    torch.testing.assert_close(alone, kept)
    coarse = photo_consistency_share(index[:, :162], images, RIG, NUM_HYPOTHESES, MIN_DEPTH)
    torch.testing.assert_close(coarse, alone, atol=0.03, rtol=0)


def test_a_share_is_reached_over_most_where_two_cameras_see() -> None:
    """By hand: between hypotheses correlation is linear, and what fewer than two cameras see does not count."""
    correlation = torch.tensor([[[0.2, 0.9], [0.8, 0.1], [0.4, 0.5]]])
    known = torch.ones_like(correlation, dtype=torch.bool)
    place = torch.tensor([[0.25, 0.5]])
    torch.testing.assert_close(
        consistency_share(place, correlation, known), torch.tensor([(0.5 + 0.1) / (0.8 + 0.9)])
    )
    known[0, 0, 1] = False  # the 0.9 is nobody's
    torch.testing.assert_close(
        consistency_share(place, correlation, known), torch.tensor([(0.5 + 0.1) / (0.8 + 0.5)])
    )
    known[:, :, 1] = False
    torch.testing.assert_close(consistency_share(place, correlation, known), torch.tensor([0.5 / 0.8]))
    assert consistency_share(place, correlation, ~(correlation > 2) & False).isnan().all()


def test_a_depth_at_which_no_two_cameras_see_a_thing_has_no_share() -> None:
    """Back to back, two lenses of 220° see the same far away, and at half a metre one or none sees anything."""
    rig = ring_rig(2)
    images = sphere_at(0.0, rig, level=3)
    far, near = (
        photo_consistency_share(torch.full((1, 162), index), images, rig, NUM_HYPOTHESES, MIN_DEPTH)
        for index in (0.0, 8.0)
    )
    assert 0.9 < far.item() <= 1
    assert near.isnan()


def test_winner_takes_all_reaches_almost_all() -> None:
    images = sphere_at(4.0, RIG, level=4)
    found = photo_consistency(images, RIG, 17, MIN_DEPTH, level=3).index
    assert photo_consistency_share(found, images, RIG, 17, MIN_DEPTH).item() > 0.9
