# SPDX-License-Identifier: Apache-2.0
"""Roots of increasing functions, against plain bisection and closed forms."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from sphericalvision.geometry import increasing_limit, polynomial, solve_increasing

ZERO = torch.tensor(0.0, dtype=torch.float64)


def test_polynomial_against_numpy(generator: torch.Generator) -> None:
    coefficients = torch.randn(4, 6, generator=generator, dtype=torch.float64)
    x = torch.randn(4, generator=generator, dtype=torch.float64)
    value, derivative = polynomial(coefficients, x)
    for row, at, v, d in zip(coefficients.numpy(), x.numpy(), value, derivative, strict=True):
        expected = np.polynomial.Polynomial(row)
        np.testing.assert_allclose([v, d], [expected(at), expected.deriv()(at)])


def flat_then_steep(x: Tensor) -> tuple[Tensor, Tensor]:
    """x⁹ + x/1000: Newton's method alone overshoots far from its root."""
    return x**9 + x / 1000, 9 * x**8 + 0.001


def test_against_bisection_where_newton_alone_overshoots() -> None:
    target = torch.logspace(-6, 2.5, 200, dtype=torch.float64)
    root, converged = solve_increasing(flat_then_steep, target, ZERO, ZERO + 2, iterations=60)
    low, high = torch.zeros_like(target), torch.full_like(target, 2)
    for _ in range(100):
        middle = (low + high) / 2
        below = flat_then_steep(middle)[0] < target
        low, high = torch.where(below, middle, low), torch.where(below, high, middle)
    assert converged.all()
    torch.testing.assert_close(root, (low + high) / 2, rtol=1e-12, atol=1e-15)


def test_targets_beyond_the_bracket_say_so_and_have_no_gradient() -> None:
    target = torch.tensor([-1.0, 0.5, 9.0], dtype=torch.float64, requires_grad=True)
    root, converged = solve_increasing(lambda x: (x * x, 2 * x), target, ZERO, ZERO + 2)
    assert converged.tolist() == [False, True, False]
    torch.testing.assert_close(root.detach(), torch.tensor([0.0, math.sqrt(0.5), 2.0], dtype=torch.float64))
    (gradient,) = torch.autograd.grad(root.sum(), target)
    torch.testing.assert_close(gradient, torch.tensor([0.0, math.sqrt(0.5), 0.0], dtype=torch.float64))


def test_implicit_derivatives_of_first_and_second_order() -> None:
    """With respect to the target and to a parameter of the function."""
    target = torch.tensor([0.3, 1.2], dtype=torch.float64, requires_grad=True)
    slope = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)

    def root(target: Tensor, slope: Tensor) -> Tensor:
        return solve_increasing(lambda x: (slope * x + x**3, slope + 3 * x * x), target, ZERO, ZERO + 3).value

    assert torch.autograd.gradcheck(root, (target, slope))
    assert torch.autograd.gradgradcheck(root, (target, slope))


def test_increasing_limit_is_just_before_the_turn() -> None:
    limit = increasing_limit(torch.cos, torch.tensor([1.0, 3.0, 6.0], dtype=torch.float64), samples=1001)
    assert limit[0] == 1.0  # sin rises all the way
    assert ((math.pi / 2 - limit[1:] >= 0) & (math.pi / 2 - limit[1:] <= 0.006)).all()
