# SPDX-License-Identifier: Apache-2.0
"""Nonlinear least squares of few parameters: Levenberg-Marquardt within bounds."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.kernels import full_precision

_ITERATIONS = 100  # most steps taken
_TOLERANCE = 1e-9  # the search ends when a step makes the sum smaller by less than this fraction
_PATIENCE = 12  # rejected steps in a row, each with ten times the damping


class LeastSquares(NamedTuple):
    """A minimum and how good it is."""

    solution: Float[Tensor, " p"]
    """Parameters (p,)."""
    rms: float
    """Root of the mean of the squared residuals there."""


@torch.no_grad()
@full_precision
def solve_least_squares(
    residuals: Callable[[Tensor], Tensor],
    start: Float[Tensor, " p"],
    jacobian: Callable[[Tensor], Tensor] | None = None,
    lower: Float[Tensor, " p"] | None = None,
    upper: Float[Tensor, " p"] | None = None,
) -> LeastSquares:
    """Parameters (p,) near ``start`` that make the sum of the squared ``residuals`` (m,) smallest.

    Levenberg-Marquardt with columns scaled to unit length, so that the units of the parameters do not matter. A
    parameter at its bound stays there as long as the residuals push it outwards.

    Args:
        residuals: maps parameters (p,) to residuals (m,), differentiable; m is not below p.
        start: (p,), floating point; float64 for more than six digits.
        jacobian: maps parameters (p,) to the derivatives (m, p); by default ``torch.func.jacfwd`` of the residuals.
        lower: smallest parameters (p,); a parameter with equal bounds is fixed.
        upper: largest parameters (p,).

    References:
        J. Nocedal, S. Wright, "Numerical Optimization", 2nd ed. (2006), section 10.3.

    Examples:
        >>> time = torch.linspace(0, 1, 20, dtype=torch.float64)
        >>> measured = 3 * torch.exp(-2 * time)
        >>> decay = lambda p: p[0] * torch.exp(-p[1] * time) - measured
        >>> solution, rms = solve_least_squares(decay, torch.ones(2, dtype=torch.float64))
        >>> [round(value, 9) for value in solution.tolist()], rms < 1e-12
        ([3.0, 2.0], True)
    """
    low = torch.full_like(start, -torch.inf) if lower is None else lower
    high = torch.full_like(start, torch.inf) if upper is None else upper
    jacobian = jacobian or torch.func.jacfwd(residuals)
    x = start.clamp(low, high)
    residual = residuals(x)
    cost, damping = _cost(residual), 1e-3
    for _ in range(_ITERATIONS):
        if not 0 < cost < torch.inf:
            break
        columns = jacobian(x)
        gradient = columns.mT @ residual
        held = ((x <= low) & (gradient > 0)) | ((x >= high) & (gradient < 0)) | (low == high)
        length = torch.linalg.vector_norm(columns, dim=0)
        scale = torch.where(held | (length == 0), 0.0, 1 / torch.where(length == 0, 1.0, length))
        rows = torch.cat((torch.nan_to_num(columns * scale), residual[:, None]), -1)
        # Many rows are turned into as many as columns, at a fifth of the singular values' cost
        if len(rows) > rows.shape[1]:
            rows = torch.linalg.qr(rows, mode="r").R
        u, s, vh = torch.linalg.svd(rows[:, :-1], full_matrices=False)
        along = u.mT @ rows[:, -1]
        for _ in range(_PATIENCE):
            step = -scale * (vh.mT @ (s / (s * s + damping) * along))
            candidate = (x + step).clamp(low, high)
            candidate_residual = residuals(candidate)
            candidate_cost = _cost(candidate_residual)
            if candidate_cost < cost:
                break
            damping = min(damping * 10, 1e8)
        else:
            break  # no direction leads down any more
        gain = 1 - candidate_cost / cost
        x, residual, cost, damping = candidate, candidate_residual, candidate_cost, max(damping / 10, 1e-12)
        if gain < _TOLERANCE:
            break
    return LeastSquares(x, (cost / max(residual.numel(), 1)) ** 0.5)


def _cost(residual: Tensor) -> float:
    cost = float((residual * residual).sum())
    return cost if cost == cost else float("inf")
