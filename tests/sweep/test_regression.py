# SPDX-License-Identifier: Apache-2.0
"""The expected index under a softmax."""

from __future__ import annotations

import pytest
import torch

from sphericalvision.sweep import depth_estimate, soft_argmax, soft_argmax_confidence
from sphericalvision.sweep.winner import at_nearest_hypothesis


def test_soft_argmax_is_the_expectation(generator: torch.Generator) -> None:
    logits = torch.randn(2, 5, 7, dtype=torch.float64, generator=generator)
    weights = logits.exp()
    expected = sum(i * weights[:, i] for i in range(5)) / weights.sum(1)
    torch.testing.assert_close(soft_argmax(logits), expected)


def test_soft_argmax_ignores_a_common_offset_and_survives_large_scores() -> None:
    logits = torch.tensor([[[1e4], [-1e4], [1e4]]])
    assert soft_argmax(logits).item() == pytest.approx(1.0)
    torch.testing.assert_close(soft_argmax(logits - 1e4), soft_argmax(logits))


def test_confidence_of_one_peak_of_two_and_of_none() -> None:
    one, two, none = (torch.full((16, 1), -30.0) for _ in range(3))
    one[5], two[2], two[13], none[:] = 30.0, 30.0, 30.0, 0.0
    confidence = [soft_argmax_confidence(logits).item() for logits in (one, two, none)]
    assert confidence == pytest.approx([1.0, 0.0, 4 / 16], abs=1e-6)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16, torch.float32])
def test_convention_expectation_in_single_precision(generator: torch.Generator, dtype: torch.dtype) -> None:
    """Half precision has no number between 150 and 151: scores may be rounded to it, the answer is not."""
    logits = torch.randn(2, 192, 642, generator=generator).to(dtype)
    exact = soft_argmax(logits.double())
    confidence = soft_argmax_confidence(logits.double())
    for mixed in (False, True):
        with torch.autocast("cpu", torch.bfloat16, enabled=mixed):
            index, found = soft_argmax(logits), soft_argmax_confidence(logits)
        assert index.dtype == found.dtype == torch.float32
        torch.testing.assert_close(index, exact.float(), rtol=0, atol=1e-3)
        away = (exact - exact.round()).abs() > 1e-3  # where rounding cannot choose other hypotheses
        torch.testing.assert_close(found[away], confidence[away].float(), rtol=0, atol=1e-4)
    assert len(index.unique()) > 1000
    assert exact.dtype == confidence.dtype == torch.float64


def test_an_estimate_is_seen_where_two_cameras_see_it(generator: torch.Generator) -> None:
    logits = 5 * torch.randn(2, 6, 40, generator=generator)
    seen = torch.rand(2, 3, 6, 40, generator=generator) > 0.4
    estimate = depth_estimate(logits, seen)
    assert torch.equal(estimate.index, soft_argmax(logits))
    assert torch.equal(estimate.confidence, soft_argmax_confidence(logits))
    for b, v in torch.cartesian_prod(torch.arange(2), torch.arange(40)).tolist():
        nearest = round(float(estimate.index[b, v]))
        assert estimate.seen[b, v] == (seen[b, :, nearest, v].sum() >= 2)


def test_what_is_not_a_number_stays_so() -> None:
    logits, seen = torch.zeros(1, 4, 3), torch.ones(1, 2, 4, 3, dtype=torch.bool)
    logits[0, 2, 1] = torch.nan
    found = depth_estimate(logits, seen)
    assert found.index.isnan().tolist() == found.confidence.isnan().tolist() == [[False, True, False]]
    values = torch.arange(4.0).view(1, 4, 1).expand(1, 4, 3)
    index = torch.tensor([[torch.nan, -1.0, 9.0]])
    assert at_nearest_hypothesis(values, index).tolist() == [[0, 0, 3]]
