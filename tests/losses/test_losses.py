# SPDX-License-Identifier: Apache-2.0
"""The masked Huber loss of hypothesis indices."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from sphericalvision.losses import depth_index_huber


@pytest.mark.parametrize("weights", [None, torch.linspace(0, 2, 50)])
@pytest.mark.parametrize("delta", [0.5, 1.0, 2.0])
def test_equals_its_definition(generator: torch.Generator, delta: float, weights: Tensor | None) -> None:
    pred, target = 3 * torch.randn(2, 2, 50, generator=generator)
    mask = torch.rand(2, 50, generator=generator) > 0.4
    error = (pred - target).abs()
    losses = torch.where(error <= delta, 0.5 * error**2, delta * (error - 0.5 * delta))
    known = mask * (torch.ones(50) if weights is None else weights)
    expected = ((losses * known).sum(1) / known.sum(1)).mean()  # of each sample, and of these
    found = depth_index_huber(pred, target.where(mask, torch.nan), mask, delta, weights)
    torch.testing.assert_close(found, expected)


def test_without_a_mask_all_points_count(generator: torch.Generator) -> None:
    pred, target = torch.randn(2, 2, 50, generator=generator)
    everywhere = torch.ones(2, 50, dtype=torch.bool)
    torch.testing.assert_close(depth_index_huber(pred, target), depth_index_huber(pred, target, everywhere))


def test_weights_are_those_of_any_grid(generator: torch.Generator) -> None:
    pred, target = torch.randn(2, 2, 4, 8, generator=generator)
    weights = torch.rand(4, 8, generator=generator)
    flat = depth_index_huber(pred.flatten(1), target.flatten(1), weights=weights.flatten())
    torch.testing.assert_close(depth_index_huber(pred, target, weights=weights), flat)


def test_empty_mask_is_no_loss() -> None:
    pred = torch.tensor([[1.0]], requires_grad=True)
    loss = depth_index_huber(pred, torch.tensor([[5.0]]), torch.tensor([[False]]))
    loss.backward()
    assert loss.item() == 0
    assert pred.grad is not None
    assert pred.grad.item() == 0
