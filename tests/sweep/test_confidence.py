# SPDX-License-Identifier: Apache-2.0
"""Confidence of the semi-global sweep: what it says is about true, and who keeps the surest keeps the best."""

from __future__ import annotations

import math

import pytest
import torch

from sphericalvision.cameras import ring_rig
from sphericalvision.data import SampleView
from sphericalvision.icosphere import icosphere_rings
from sphericalvision.sweep import index_from_inverse_depth, semi_global_sweep
from sphericalvision.sweep.confidence import sweep_confidence
from tests.worlds import scenes as world_scenes


def test_is_the_logistic_regression_of_margin_and_spread(generator: torch.Generator) -> None:
    """Vertex by vertex: indices within two rings, costs farther than one and a half hypotheses of two tried ones."""
    cost, correlation = (
        torch.rand(2, 12, 162, generator=generator),
        0.2 * torch.rand(2, 162, generator=generator),
    )
    index = 11 * torch.rand(2, 162, generator=generator)
    found = sweep_confidence(cost, correlation, index, substeps=2)
    one, two = icosphere_rings(2, 1), icosphere_rings(2, 2)
    for sample, vertex in ((0, 0), (0, 1), (0, 77), (1, 60), (1, 161)):
        around = index[sample, two[vertex][two[vertex] >= 0]]
        winner = round(index[sample, vertex].item())
        far = [cost[sample, j, vertex] for j in range(12) if abs(j - winner) > 3]
        margin = max(float(min(far) - cost[sample, winner, vertex]), 1e-6)
        spread = float(around.max() - around.min()) / 2
        logit = 2.27 + 0.5 * math.log(margin) - 1.12 * math.log(spread + 0.15)
        contrast = float(correlation[sample, one[vertex][one[vertex] >= 0]].mean()) / 0.1
        expected = min(contrast, 1) / (1 + math.exp(-logit))
        assert found[sample, vertex].item() == pytest.approx(expected, rel=1e-4)


@pytest.mark.slow
def test_is_the_share_of_small_errors_on_scenes_it_was_not_fitted_to() -> None:
    rig = ring_rig(4, 0.2, (192, 192))
    scenes = world_scenes(
        rig, 4, 2_000_000, SampleView(6, 4, antialias=True), kind=["room", "floating"], samples_per_pixel=2
    )
    errors, confidences = [], []
    for sample in (scenes[number] for number in range(4)):
        found = semi_global_sweep(sample["images"][None], rig, 16, 0.55, seen=sample["seen"][None])
        counts = sample["valid"] & found.seen[0]
        truth = index_from_inverse_depth(sample["inverse_depth"], 16, 0.55)
        errors.append((found.index[0] - truth).abs()[counts])
        confidences.append(found.confidence[0, counts])
    error, confidence = torch.cat(errors), torch.cat(confidences)
    assert confidence.mean().item() == pytest.approx((error < 1).float().mean().item(), abs=0.05)
    sure = confidence > 0.9
    assert (error[sure] < 1).float().mean() > 0.93
    kept = confidence.argsort(descending=True)[: int(0.8 * len(error))]
    assert error[kept].mean() < 0.6 * error.mean()
