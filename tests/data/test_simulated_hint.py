# SPDX-License-Identifier: Apache-2.0
"""Simulated hints: near the truth, where the cameras see, for some samples; one in four of another scene."""

import pytest
import torch

from sphericalvision.cameras import ring_rig
from sphericalvision.data.augmentation.simulated_hint import simulated_hint
from sphericalvision.sweep.visibility import seen_in_view
from tests.values import weighted_sum

BATCH, LEVEL = 200, 3
VERTICES = 642


def hints(seed=0, **options):
    generator = torch.Generator().manual_seed(seed)
    truth = (
        0.2
        + torch.rand(BATCH, 1, generator=generator)
        + 0.1 * torch.rand(BATCH, VERTICES, generator=generator)
    )
    valid = torch.rand(BATCH, VERTICES, generator=generator) < 0.9
    seen = seen_in_view(ring_rig(3, field_of_view=2.0), LEVEL).expand(BATCH, -1, -1)
    return truth, valid, seen, simulated_hint(truth, valid, seen, generator, **options)


def test_some_samples_have_a_hint_and_one_in_four_of_them_is_nonsense():
    truth, _valid, seen, hint = hints(share=0.4)
    known = hint.weight > 0
    present = known.any(1)
    assert 0.25 < present.float().mean() < 0.5
    assert not (known & ~seen.any(1)).any()
    assert hint.weight.min() == 0
    assert hint.weight.max() <= 1
    assert (hint.inverse_depth >= 0).all()
    error = (hint.inverse_depth / truth).log().abs().where(known, 0.0).sum(1) / known.sum(1).clamp(min=1)
    nonsense = (error > 0.35)[present].float().mean()  # those of depths as near are not told from others
    assert 0.08 < nonsense < 0.3
    assert 0.01 < error[present].quantile(0.3) < 0.12
    assert (hint.weight.amax(1)[present] < 0.5).float().mean() > 0.05  # those that are 15 % off know it


def test_hints_are_of_points_of_one_camera_or_of_all():
    _, _, seen, hint = hints(share=1.0)
    known = hint.weight > 0
    sparse = known.float().mean(1) < 0.11
    assert 0.15 < sparse.float().mean() < 0.5
    outside = [(known & ~seen[:, camera]).any(1) for camera in range(3)]
    single = ~torch.stack(outside).all(0)
    assert 0.15 < single[~sparse].float().mean() < 0.5


def test_a_seed_is_the_hints_that_it_was():
    """Above the level of the fields, too, and of cameras of which each sees another part."""
    generator = torch.Generator().manual_seed(5)
    truth, valid = (torch.rand(40, 2562, generator=generator) for _ in range(2))
    seen = torch.rand(40, 3, 2562, generator=generator) < torch.tensor([0.9, 0.6, 0.3])[:, None]
    hint = simulated_hint(truth, valid < 0.8, seen, generator)
    assert weighted_sum(hint.inverse_depth, hint.weight) == pytest.approx(-32.0073, abs=0.02)


def test_cameras_may_see_a_finer_icosphere():
    truth, valid, _, hint = hints(seed=1)
    fine = seen_in_view(ring_rig(3, field_of_view=2.0), LEVEL + 1).expand(BATCH, -1, -1)
    generator = torch.Generator().manual_seed(1)
    for size in ((BATCH, 1), (BATCH, VERTICES), (BATCH, VERTICES)):  # what the truth was drawn with
        torch.rand(size, generator=generator)
    finer = simulated_hint(truth, valid, fine, generator)
    assert torch.equal(finer.weight, hint.weight)
    assert torch.equal(finer.inverse_depth, hint.inverse_depth)


def test_the_generator_alone_decides():
    (one, other), third = (hints(seed=1)[3] for _ in range(2)), hints(seed=2)[3]
    assert torch.equal(one.weight, other.weight)
    assert torch.equal(one.inverse_depth, other.inverse_depth)
    assert not torch.equal(one.weight, third.weight)
