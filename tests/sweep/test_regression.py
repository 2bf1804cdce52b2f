# SPDX-License-Identifier: Apache-2.0
"""The expected index under a softmax."""

from __future__ import annotations

import pytest
import torch

from sphericalvision.core import ShapeError
from sphericalvision.sweep import soft_argmax, soft_argmax_confidence


def test_soft_argmax_is_the_expectation(generator: torch.Generator) -> None:
    logits = torch.randn(2, 5, 7, dtype=torch.float64, generator=generator)
    weights = logits.exp()
    expected = sum(i * weights[:, i] for i in range(5)) / weights.sum(1)
    torch.testing.assert_close(soft_argmax(logits), expected)


def test_soft_argmax_ignores_a_common_offset_and_survives_large_scores() -> None:
    logits = torch.tensor([[[1e4], [-1e4], [1e4]]])
    assert soft_argmax(logits).item() == pytest.approx(1.0)
    torch.testing.assert_close(soft_argmax(logits - 1e4), soft_argmax(logits))


def test_soft_argmax_mirrors_with_the_hypotheses(generator: torch.Generator) -> None:
    logits = torch.randn(1, 8, 12, generator=generator)
    torch.testing.assert_close(soft_argmax(logits.flip(1)), 7 - soft_argmax(logits))


def test_soft_argmax_gradient(generator: torch.Generator) -> None:
    logits = torch.randn(1, 4, 3, dtype=torch.float64, generator=generator, requires_grad=True)
    assert torch.autograd.gradcheck(soft_argmax, logits)


def test_confidence_of_one_peak_of_two_and_of_none() -> None:
    one, two, none = (torch.full((16, 1), -30.0) for _ in range(3))
    one[5], two[2], two[13], none[:] = 30.0, 30.0, 30.0, 0.0
    confidence = [soft_argmax_confidence(logits).item() for logits in (one, two, none)]
    assert confidence == pytest.approx([1.0, 0.0, 4 / 16], abs=1e-6)


def test_one_dimension_is_refused() -> None:
    with pytest.raises(ShapeError, match="logits"):
        soft_argmax(torch.zeros(8))
