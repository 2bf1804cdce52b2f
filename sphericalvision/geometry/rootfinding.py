# SPDX-License-Identifier: Apache-2.0
"""Polynomials, and roots of increasing functions of one variable: vectorised, with implicit derivatives.

A table of the inverse (``tabulate_inverse``) is a start from which two steps find a root.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor


class Root(NamedTuple):
    """A root and whether one was found inside the bracket."""

    value: Tensor
    """The root (*); the nearer end of the bracket where none was found."""
    converged: Tensor
    """True (*) where the bracket holds a root."""


def _horner(coefficients: Tensor, x: Tensor, order: int) -> list[Tensor]:
    """The polynomial's first Taylor coefficients at ``x``: value, derivative, half the second one, ..., each (*)."""
    descending = coefficients.unbind(-1)[::-1]
    taylor = [descending[0]]  # grows by one with each coefficient, up to what is asked for
    for coefficient in descending[1:]:
        previous = taylor
        taylor = [torch.addcmul(coefficient, previous[0], x)]
        taylor += [torch.addcmul(previous[k - 1], previous[k], x) for k in range(1, len(previous))]
        if len(previous) <= order:
            taylor.append(previous[-1])
    if len(descending) <= order + 1:  # too few for all to have got the shape of x
        zero = torch.zeros_like(taylor[0] + x)
        taylor = [value + zero for value in taylor] + [zero] * (order + 1 - len(taylor))
    return taylor


def with_leading_one(coefficients: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch m"]:
    """The coefficients (*, n + 1) of 1 + c1 x + c2 x² + ..., of which (*, n) the first is left out.

    Examples:
        >>> with_leading_one(torch.tensor([3.0])).tolist()
        [1.0, 3.0]
    """
    return torch.cat((torch.ones_like(coefficients[..., :1]), coefficients), dim=-1)


def polynomial_value(
    coefficients: Float[Tensor, "*coefficients n"], x: Float[Tensor, " ..."]
) -> Float[Tensor, " ..."]:
    """Value (*) at ``x`` (*) of the polynomials with ascending ``coefficients`` (*, n).

    Examples:
        >>> polynomial_value(torch.tensor([1.0, 0.0, 3.0]), torch.tensor(2.0)).item()  # 1 + 3 x²
        13.0
    """
    return _horner(coefficients, x, 0)[0]


def polynomial(
    coefficients: Float[Tensor, "*coefficients n"], x: Float[Tensor, " ..."]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Value and derivative (*) at ``x`` (*) of the polynomials with ascending ``coefficients`` (*, n).

    Examples:
        >>> value, derivative = polynomial(torch.tensor([1.0, 0.0, 3.0]), torch.tensor(2.0))  # 1 + 3 x²
        >>> value.item(), derivative.item()
        (13.0, 12.0)
    """
    value, derivative = _horner(coefficients, x, 1)
    return value, derivative


def polynomial_with_curvature(
    coefficients: Float[Tensor, "*coefficients n"], x: Float[Tensor, " ..."]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Value, first and second derivative (*) at ``x`` (*) of the polynomials with ascending ``coefficients`` (*, n).

    Examples:
        >>> [value.item() for value in polynomial_with_curvature(torch.tensor([1.0, 0.0, 3.0]), torch.tensor(2.0))]
        [13.0, 12.0, 6.0]
    """
    value, derivative, half = _horner(coefficients, x, 2)
    return value, derivative, 2 * half


def increasing_limit(
    derivative: Callable[[Tensor], Tensor],
    upper: Float[Tensor, "*batch"],
    samples: int = 128,
    refinements: int = 2,
) -> Float[Tensor, "*batch"]:
    """How far from 0 towards ``upper`` (*) a function increases.

    The first of ``samples`` at which it does not is looked for. Between it and the sample before, the zero of the
    derivative is found by the rule of false position, ``refinements`` times. The limit (*) carries no derivative.
    ``derivative`` maps (*, samples) and (*, 1) to the same shape.

    Examples:
        >>> round(increasing_limit(torch.cos, torch.tensor(3.2), samples=65).item(), 5)  # sin rises up to π/2
        1.5708
    """
    with torch.no_grad():
        steps = torch.linspace(0, 1, samples, dtype=upper.dtype, device=upper.device)
        at = upper.unsqueeze(-1) * steps
        slope = derivative(at)
        rising = (slope > 0).to(torch.long).cumprod(-1).sum(-1, keepdim=True)
        last, following = (rising - 1).clamp_min(0), rising.clamp_max(samples - 1)
        # The same place where all samples rise, or none does
        low, high = at.gather(-1, last), at.gather(-1, following)
        positive, negative = slope.gather(-1, last), slope.gather(-1, following)
        for _ in range(refinements):
            estimate = _false_position(low, high, positive, negative)
            slope = derivative(estimate)
            above = slope > 0
            low, positive = torch.where(above, estimate, low), torch.where(above, slope, positive)
            high, negative = torch.where(above, high, estimate), torch.where(above, negative, slope)
        limit = _false_position(low, high, positive, negative)
        return torch.where(rising < samples, limit, upper.unsqueeze(-1)).squeeze(-1)


def _false_position(low: Tensor, high: Tensor, positive: Tensor, negative: Tensor) -> Tensor:
    """Where the straight line from (low, positive) to (high, negative) meets 0."""
    fraction = (positive / (positive - negative)).nan_to_num(0.0).clamp(0, 1)
    return torch.lerp(low, high, fraction)


def refine_root(
    function: Callable[[Tensor], tuple[Tensor, Tensor, Tensor]],
    target: Float[Tensor, " ..."],
    start: Float[Tensor, " ..."],
    upper: Float[Tensor, " ..."],
) -> Root:
    """Solve ``function(x) = target`` for ``x`` (*) in [0, upper] from a start close by: two steps of Halley's method.

    Each step cubes the error, as measured by the curvature of the function: from a start good to two digits to all of
    float64's. The first step is not recorded by autograd. The second is, and alone carries exact first and second
    derivatives with respect to the target and to everything that ``function`` depends on. Converged means that the
    second step was too small for a third one to matter.

    Args:
        function: maps x (*) to its value, its derivative, which is positive, and its second derivative, each (*).
        target: wanted values (*).
        start: where to start (*), for instance ``InverseTable.lookup``.
        upper: the end of the range, broadcastable to (*).

    References:
        E. Halley, "A new, exact and easy method of finding the roots of equations", Phil. Trans. 18 (1694).

    Examples:
        >>> cube = lambda x: (x**3, 3 * x**2, 6 * x)
        >>> two = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
        >>> root = refine_root(cube, two, torch.tensor(1.25, dtype=torch.float64), torch.tensor(2.0))
        >>> (slope,) = torch.autograd.grad(root.value, two)
        >>> round(root.value.item(), 12), round(slope.item(), 12)  # ∛2 and 1 / (3 ∛4)
        (1.259921049895, 0.209986841649)
    """
    with torch.no_grad():
        x = torch.minimum((start - _halley_step(function, target, start)).clamp_min(0), upper)
    step = _halley_step(function, target, x)
    return Root(x - step, step.abs() <= torch.finfo(step.dtype).eps ** 0.4 * upper)


def _halley_step(
    function: Callable[[Tensor], tuple[Tensor, Tensor, Tensor]], target: Tensor, x: Tensor
) -> Tensor:
    value, slope, curvature = function(x)
    slope = slope.clamp_min(torch.finfo(slope.dtype).eps)
    newton = (value - target) / slope
    one = torch.ones((), dtype=slope.dtype, device=slope.device)
    return newton / torch.addcmul(one, newton, curvature / slope, value=-0.5).clamp_min(0.25)


def _place(share: Tensor) -> Tensor:
    """From the share (*) of the largest value in [0, 1] to the place in the table, in [0, 1].

    The square root makes the inverse smooth where the function ends at a turning point.
    """
    return 1 - (1 - share).clamp(0, 1).sqrt()


class InverseTable(NamedTuple):
    """Arguments of an increasing function that starts at 0, for values from 0 to its largest; without derivatives."""

    limit: Float[Tensor, "*batch"]
    """The largest value (*b)."""
    knots: Float[Tensor, "*batch size"]
    """The arguments (*b, size)."""
    steps: Float[Tensor, "*batch size"]
    """From each argument to the next one, (*b, size)."""

    def lookup(self, value: Float[Tensor, " ..."]) -> Float[Tensor, " ..."]:
        """The argument (*b, *) of ``value`` (*b, *), interpolated; the last one for larger values.

        ``value`` has as many dimensions as ``limit`` and broadcasts with it; NaN gives the first argument.
        """
        with torch.no_grad():
            size = self.knots.shape[-1]
            position = (size - 1) * _place(value.detach() / self.limit).nan_to_num(0.0)
            below = position.floor()
            index = below.int()
            if self.limit.numel() > 1:
                tables = torch.arange(self.limit.numel(), dtype=torch.int32, device=index.device)
                index = index + size * tables.reshape(self.limit.shape)
            flat = index.reshape(-1)
            knot, step = (table.reshape(-1).index_select(0, flat) for table in (self.knots, self.steps))
            return torch.addcmul(knot.reshape(index.shape), position - below, step.reshape(index.shape))


def samples_towards(upper: Float[Tensor, "*batch"], samples: int = 512) -> Float[Tensor, "*batch n"]:
    """Arguments (*, samples) from 0 to ``upper`` (*), closer and closer, for ``tabulate_inverse``.

    Examples:
        >>> samples_towards(torch.tensor(16.0), 5).tolist()
        [0.0, 7.0, 12.0, 15.0, 16.0]
    """
    fraction = torch.linspace(1, 0, samples, dtype=upper.dtype, device=upper.device)
    return upper.unsqueeze(-1) * (1 - fraction * fraction)


def tabulate_inverse(
    arguments: Float[Tensor, "*#batch n"], values: Float[Tensor, "*batch n"]
) -> InverseTable:
    """Make the table of an increasing function from samples of it.

    Args:
        arguments: (*b, n) increasing, best ``samples_towards`` the last one.
        values: (*b, n) at the arguments, from 0 up. If the last one is a turning point of the function, the table is as
            good there as elsewhere.

    Examples:
        >>> angle = samples_towards(torch.tensor(torch.pi / 2))
        >>> arcsine = tabulate_inverse(angle, angle.sin())  # which has an infinite slope at 1
        >>> sine = torch.tensor([0.0, 0.3, 0.99, 1.0])
        >>> (arcsine.lookup(sine) - sine.asin()).abs() < 1e-3
        tensor([True, True, True, True])
    """
    with torch.no_grad():
        arguments = arguments.expand(values.shape)
        positions = _place(values / values[..., -1:]).contiguous()
        targets = torch.linspace(0, 1, 512, dtype=values.dtype, device=values.device)
        targets = targets + torch.zeros_like(positions[..., :1])  # batched by vmap if the places are
        above = torch.searchsorted(positions, targets).clamp(1, values.shape[-1] - 1)
        low, high = positions.gather(-1, above - 1), positions.gather(-1, above)
        fraction = ((targets - low) / (high - low)).nan_to_num(0.0).clamp(0, 1)
        knots = torch.lerp(arguments.gather(-1, above - 1), arguments.gather(-1, above), fraction)
        steps = torch.cat((knots.diff(dim=-1), torch.zeros_like(knots[..., :1])), dim=-1)
        return InverseTable(values[..., -1], knots, steps)
