# SPDX-License-Identifier: Apache-2.0
"""The odd polynomial θ g(θ²) with g(s) = 1 + k1 s + k2 s² + ..., the radial part of Kannala-Brandt lenses.

``coefficients`` (*, k + 1) are those of g, the leading 1 included.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.fitting.model import Samples
from sphericalvision.cameras.fitting.starts import solve_linear
from sphericalvision.geometry.rootfinding import (
    InverseTable,
    increasing_limit,
    polynomial,
    polynomial_value,
    polynomial_with_curvature,
    samples_towards,
    tabulate_inverse,
)

__all__ = ["Inverse", "radial_solution", "squared_radius", "tabulated", "widest_angle"]


def _radius_slope(coefficients: Tensor, squared: Tensor) -> Tensor:
    """Derivative of θ g(θ²) with respect to θ, from θ²."""
    value, derivative = polynomial(coefficients, squared)
    return value + 2 * squared * derivative


def squared_radius(
    coefficients: Float[Tensor, "*coefficients k"], squared: Float[Tensor, " ..."]
) -> tuple[Float[Tensor, " ..."], Float[Tensor, " ..."], Float[Tensor, " ..."]]:
    """The squared image radius s g(s)² of a squared angle s, and its first two derivatives with respect to s."""
    g, slope, curvature = polynomial_with_curvature(coefficients, squared)
    radius_slope = torch.addcmul(g, squared, slope, value=2)  # of θ g(θ²) with respect to θ
    scaled = squared * g
    further = slope * torch.add(radius_slope, g, alpha=3)
    return scaled * g, g * radius_slope, torch.addcmul(further, scaled, curvature, value=2)


def widest_angle(coefficients: Float[Tensor, "*batch k"]) -> Float[Tensor, "*batch"]:
    """The angle (*) in [0, π] up to which the image radius grows."""
    start = torch.full_like(coefficients[..., 0], math.pi)
    return increasing_limit(
        lambda angle: _radius_slope(coefficients.unsqueeze(-2), angle * angle), start, samples=256
    )


class Inverse(NamedTuple):
    """Squared angles of squared image radii q, to some digits, and the largest q (*)."""

    table: InverseTable
    most: Tensor

    def lookup(self, squared_radius: Float[Tensor, " ..."]) -> Float[Tensor, " ..."]:
        """The squared angle (*)."""
        return self.table.lookup(_spread(squared_radius, self.most))


def _spread(squared_radius: Tensor, most: Tensor) -> Tensor:
    """Grows with q, half for q around 1 and half for larger ones: at π the radius may be hundreds of focal lengths."""
    middle = (1 + most).sqrt()
    return squared_radius / (1 + squared_radius) + squared_radius / (middle + squared_radius)


def tabulated(coefficients: Float[Tensor, "*batch k"], widest: Float[Tensor, "*batch"]) -> Inverse:
    """The inverse up to the angle ``widest`` (*)."""
    with torch.no_grad():
        angle = samples_towards(widest)
        squared = angle * angle
        squared_radius = squared * polynomial_value(coefficients.unsqueeze(-2), squared).square()
        most = squared_radius[..., -1:]
        return Inverse(tabulate_inverse(squared, _spread(squared_radius, most)), most.squeeze(-1))


def radial_solution(samples: Samples, size: int) -> Float[Tensor, " k"]:
    """So many coefficients (size,) by linear least squares."""
    angle = samples.angle
    powers = torch.stack([angle ** (2 * k + 3) for k in range(size)], dim=-1)
    return solve_linear(powers, samples.radius - angle)
