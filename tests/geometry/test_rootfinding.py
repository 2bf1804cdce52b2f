# SPDX-License-Identifier: Apache-2.0
"""Roots of increasing functions, against plain bisection and closed forms."""

import math

import numpy as np
import torch
from torch import Tensor

from sphericalvision.geometry.rootfinding import increasing_limit, polynomial, refine_root


def test_polynomial_against_numpy(generator: torch.Generator) -> None:
    coefficients = torch.randn(4, 6, generator=generator, dtype=torch.float64)
    x = torch.randn(4, generator=generator, dtype=torch.float64)
    value, derivative = polynomial(coefficients, x)
    for row, at, v, d in zip(coefficients.numpy(), x.numpy(), value, derivative, strict=True):
        expected = np.polynomial.Polynomial(row)
        np.testing.assert_allclose([v, d], [expected(at), expected.deriv()(at)])


def cubic(slope: Tensor, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """slope · x + x³ and its first two derivatives."""
    return slope * x + x**3, slope + 3 * x * x, 6 * x


def test_against_bisection_from_a_start_of_two_digits() -> None:
    target = torch.linspace(0.01, 9.0, 200, dtype=torch.float64)
    slope = torch.tensor(0.7, dtype=torch.float64)
    low, high = torch.zeros_like(target), torch.full_like(target, 3)
    for _ in range(100):
        middle = (low + high) / 2
        below = cubic(slope, middle)[0] < target
        low, high = torch.where(below, middle, low), torch.where(below, high, middle)
    expected = (low + high) / 2
    root, converged = refine_root(lambda x: cubic(slope, x), target, 0.99 * expected, torch.tensor(3.0))
    assert converged.all()
    torch.testing.assert_close(root, expected, rtol=1e-13, atol=0)


def test_a_start_that_is_far_off_says_so() -> None:
    target = torch.tensor([1.7], dtype=torch.float64)
    slope = torch.tensor(0.7, dtype=torch.float64)
    assert not refine_root(lambda x: cubic(slope, x), target, 30 * target, torch.tensor(60.0)).converged


def test_implicit_derivatives_of_first_and_second_order() -> None:
    """With respect to the target and to a parameter of the function."""
    target = torch.tensor([0.3, 1.2], dtype=torch.float64, requires_grad=True)
    slope = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
    start = torch.tensor([0.36, 0.84], dtype=torch.float64)

    def root(target: Tensor, slope: Tensor) -> Tensor:
        return refine_root(lambda x: cubic(slope, x), target, start, torch.tensor(3.0)).value

    assert torch.autograd.gradcheck(root, (target, slope))
    assert torch.autograd.gradgradcheck(root, (target, slope))


def test_increasing_limit_is_just_before_the_turn() -> None:
    ends = torch.tensor([1.0, 3.0, 6.0], dtype=torch.float64)
    limit = increasing_limit(torch.cos, ends, samples=65)
    assert limit[0] == 1.0  # sin rises all the way
    assert (limit[1:] - math.pi / 2).abs().max() < 1e-9
    assert increasing_limit(lambda x: -torch.ones_like(x), ends).abs().max() == 0  # falls from the start
    limit = increasing_limit(torch.cos, ends, samples=1001, refinements=0)
    assert ((math.pi / 2 - limit[1:] >= 0) & (math.pi / 2 - limit[1:] <= 0.006)).all()
