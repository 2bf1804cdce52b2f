# SPDX-License-Identifier: Apache-2.0
"""Roots of increasing functions of one variable: bracketed Newton, vectorised, with implicit derivatives."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["Root", "increasing_limit", "polynomial", "solve_increasing"]


class Root(NamedTuple):
    """A root and whether one was found inside the bracket."""

    value: Tensor
    """The root (*); the nearer end of the bracket where none was found."""
    converged: Tensor
    """True (*) where the bracket holds a root."""


def polynomial(coefficients: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """Value and derivative (*) at ``x`` (*) of the polynomials with ascending ``coefficients`` (*, n).

    Examples:
        >>> value, derivative = polynomial(torch.tensor([1.0, 0.0, 3.0]), torch.tensor(2.0))  # 1 + 3 x²
        >>> value.item(), derivative.item()
        (13.0, 12.0)
    """
    value = torch.zeros_like(x) + coefficients[..., -1]
    derivative = torch.zeros_like(value)
    for power in range(coefficients.shape[-1] - 2, -1, -1):
        derivative = derivative * x + value
        value = value * x + coefficients[..., power]
    return value, derivative


def increasing_limit(derivative: Callable[[Tensor], Tensor], upper: Tensor, samples: int = 128) -> Tensor:
    """How far from 0 towards ``upper`` (*) a function increases, up to one step of ``upper / samples``.

    The limit (*) carries no derivative. ``derivative`` maps (*, samples) to (*, samples).

    Examples:
        >>> round(increasing_limit(torch.cos, torch.tensor(3.2), samples=65).item(), 2)  # sin rises up to π/2
        1.55
    """
    with torch.no_grad():
        steps = torch.linspace(0, 1, samples, dtype=upper.dtype, device=upper.device)
        at = upper.unsqueeze(-1) * steps
        rising = (derivative(at) > 0).to(torch.long).cumprod(-1)
        last = (rising.sum(-1, keepdim=True) - 1).clamp_min(0)
        return at.gather(-1, last).squeeze(-1)


def solve_increasing(
    function: Callable[[Tensor], tuple[Tensor, Tensor]],
    target: Tensor,
    lower: Tensor,
    upper: Tensor,
    start: Tensor | None = None,
    iterations: int = 24,
) -> Root:
    """Solve ``function(x) = target`` for ``x`` (*) in [lower, upper], where the function increases.

    Newton steps that would leave the bracket are replaced by bisection, so the search cannot diverge. The
    search itself is not recorded by autograd: two Newton steps from the solution are, and they carry exact
    first and second derivatives with respect to the target and to everything that ``function`` depends on
    (implicit function theorem). Where the target lies outside the bracket's values the nearer end is returned,
    without derivatives.

    Args:
        function: maps x (*) to its value and derivative, each (*).
        target: wanted values (*).
        lower: one end of the bracket, broadcastable to (*).
        upper: the other end.
        start: where to start, broadcastable to (*); the middle of the bracket by default.
        iterations: fixed number of steps, so that the computation has no branch that depends on data.

    Examples:
        >>> square = lambda x: (x * x, 2 * x)
        >>> two = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
        >>> root = solve_increasing(square, two, torch.tensor(0.0), torch.tensor(2.0))
        >>> (slope,) = torch.autograd.grad(root.value, two)
        >>> round(root.value.item(), 12), round(slope.item(), 12)  # √2 and 1 / (2 √2)
        (1.414213562373, 0.353553390593)
    """
    with torch.no_grad():
        shape = torch.broadcast_shapes(target.shape, lower.shape, upper.shape)
        low, high = lower.to(target.dtype).expand(shape), upper.to(target.dtype).expand(shape)
        x = (low + high) / 2 if start is None else start.to(target.dtype).expand(shape).clamp(low, high)
        slack = 16 * torch.finfo(target.dtype).eps * target.abs()
        inside = (function(low)[0] <= target + slack) & (target - slack <= function(high)[0])
        for _ in range(iterations):
            value, slope = function(x)
            below = value < target
            low, high = torch.where(below, x, low), torch.where(below, high, x)
            step = x - (value - target) / slope
            x = torch.where((step >= low) & (step <= high), step, (low + high) / 2)  # False for NaN: bisect
        found = x
        end = function(found)[0]
    wanted = torch.where(inside, target, end)
    root = found
    for _ in range(2):
        value, slope = function(root)
        usable = slope.abs() > torch.finfo(target.dtype).tiny
        step = (value - wanted) / torch.where(usable, slope, 1.0)
        root = root - torch.where(inside & usable, step, 0.0)
    return Root(root, inside)
