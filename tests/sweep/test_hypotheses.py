# SPDX-License-Identifier: Apache-2.0
"""Hypotheses and their indices."""

from __future__ import annotations

import pytest
import torch

from sphericalvision.sweep import (
    depth_from_index,
    index_from_depth,
    index_from_inverse_depth,
    inverse_depth_from_index,
    inverse_depth_hypotheses,
)

DOUBLE = torch.float64


def test_convention_hypotheses() -> None:
    """1/d_j = (j - 1)/(N - 1)/d_min + eps; indices are j - 1: 0 is infinity, N - 1 the smallest depth."""
    # Numbers of the original implementation for N = 8 and 0.55 m.
    inverse_depths = [1.19209290e-07, 0.259740379, 0.519480639, 0.779220898]
    inverse_depths += [1.03896116, 1.29870142, 1.55844168, 1.81818194]
    depths = [
        8.38860800e06,
        3.84999823,
        1.92499956,
        1.28333314,
        0.962499890,
        0.769999929,
        0.641666618,
        0.549999964,
    ]
    found = inverse_depth_hypotheses(8, 0.55, DOUBLE)
    torch.testing.assert_close(found, torch.tensor(inverse_depths, dtype=DOUBLE), rtol=0, atol=1e-8)
    indices = torch.arange(8, dtype=DOUBLE)
    torch.testing.assert_close(
        depth_from_index(indices, 8, 0.55), torch.tensor(depths, dtype=DOUBLE), rtol=1e-8, atol=0
    )


@pytest.mark.parametrize(("number", "min_depth"), [(2, 0.1), (16, 0.55), (192, 1.65)])
def test_indices_name_the_hypotheses(number: int, min_depth: float) -> None:
    hypotheses = inverse_depth_hypotheses(number, min_depth, DOUBLE)
    indices = torch.arange(number, dtype=DOUBLE)
    torch.testing.assert_close(inverse_depth_from_index(indices, number, min_depth), hypotheses)
    torch.testing.assert_close(index_from_inverse_depth(hypotheses, number, min_depth), indices)


def test_index_and_depth_are_inverse_functions(generator: torch.Generator) -> None:
    index = torch.rand(3, 50, dtype=DOUBLE, generator=generator) * 40 + 1e-3  # beyond N - 1 too
    torch.testing.assert_close(index_from_depth(depth_from_index(index, 32, 0.55), 32, 0.55), index)


def test_infinity_has_index_zero_and_a_finite_gradient() -> None:
    depth = torch.tensor([torch.inf, 2.0], requires_grad=True)
    index = index_from_depth(depth, 32, 0.55)
    assert index[0] == 0
    index.sum().backward()
    assert depth.grad is not None
    assert depth.grad.tolist() == pytest.approx([0.0, -31 * 0.55 / 4])


@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16, torch.float32, DOUBLE, torch.int64])
@pytest.mark.parametrize(("number", "nearest"), [(2, 1e-5), (32, 0.55), (4096, 1e5)])
def test_every_index_has_a_positive_finite_depth(number: int, nearest: float, kind: torch.dtype) -> None:
    """Whatever rounding or a network makes of an index, its depth is ahead; only a NaN has none."""
    indices = torch.tensor([-torch.inf, -3.0, -1e-6, 0.0, 1e-6, 1.0, 1e9, torch.inf], dtype=DOUBLE).to(kind)
    inverse_depth = inverse_depth_from_index(indices, number, nearest)
    for found in (inverse_depth, depth_from_index(indices, number, nearest), inverse_depth.reciprocal()):
        assert found.isfinite().all()
        assert (found > 0).all()
        assert found.dtype == (DOUBLE if kind == DOUBLE else torch.float32)
    assert depth_from_index(torch.tensor(torch.nan), number, nearest).isnan()
