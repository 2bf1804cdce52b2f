# SPDX-License-Identifier: Apache-2.0
"""Radial, tangential and thin prism distortion of the normalised image plane, its Jacobian, limit and inverse.

Shared by the Brown-Conrady and the unified model. Coefficients (*, k) are in OpenCV's order, k1 k2 p1 p2 k3 k4 k5 k6
s1 s2 s3 s4, cut off after 4, 5, 8 or 12; leading dimensions broadcast with the coordinates (*).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["LARGEST_RADIUS", "Jacobian", "distort", "fold_radius", "jacobian", "radius_limit", "undistort"]

LARGEST_RADIUS = 1e4  # tan(89.994°): its eighth power still fits into float32


class Jacobian(NamedTuple):
    """Derivatives (*) of the distorted (u, v) with respect to the plane's (x, y)."""

    ux: Tensor
    uy: Tensor
    vx: Tensor
    vy: Tensor

    @property
    def determinant(self) -> Tensor:
        """Positive where the distortion keeps orientation, and so is one-to-one near by."""
        return self.ux * self.vy - self.uy * self.vx


def _numerator(coefficients: Tensor) -> list[Tensor]:
    """k1, k2 and, where present, k3."""
    return [coefficients[..., index] for index in (0, 1, 4) if index < coefficients.shape[-1]]


def _denominator(coefficients: Tensor) -> list[Tensor]:
    """k4, k5, k6 where present."""
    return [coefficients[..., index] for index in range(5, min(coefficients.shape[-1], 8))]


def _one_plus(terms: list[Tensor], squared: Tensor) -> Tensor:
    """1 + t1 s + t2 s² + ..."""
    value = terms[-1] * squared
    for term in reversed(terms[:-1]):
        value = (value + term) * squared
    return value + 1


def _slope(terms: list[Tensor], squared: Tensor) -> Tensor:
    """Derivative t1 + 2 t2 s + 3 t3 s² + ... of ``_one_plus``."""
    value = len(terms) * terms[-1]
    for power in range(len(terms) - 1, 0, -1):
        value = value * squared + power * terms[power - 1]
    return value


def _radial(coefficients: Tensor, squared: Tensor) -> Tensor:
    """The factor g(r²) of the radial distortion."""
    factor = _one_plus(_numerator(coefficients), squared)
    below = _denominator(coefficients)
    return factor / _one_plus(below, squared) if below else factor


def _radial_and_slope(coefficients: Tensor, squared: Tensor) -> tuple[Tensor, Tensor]:
    """g and its derivative with respect to r²."""
    above, below = _numerator(coefficients), _denominator(coefficients)
    factor, slope = _one_plus(above, squared), _slope(above, squared)
    if below:
        divisor = _one_plus(below, squared)
        factor = factor / divisor
        slope = (slope - factor * _slope(below, squared)) / divisor
    return factor, slope


def distort(x: Tensor, y: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor]:
    """The distorted (u, v), each (*), of the plane's points (x, y).

    Examples:
        >>> u, v = distort(torch.tensor(0.5), torch.tensor(0.0), torch.tensor([-0.4, 0.0, 0.0, 0.0]))
        >>> round(u.item(), 6), v.item()  # 0.5 (1 - 0.4 · 0.25)
        (0.45, 0.0)
    """
    p1, p2 = coefficients[..., 2], coefficients[..., 3]
    squared = x * x + y * y
    factor = _radial(coefficients, squared) + 2 * p1 * y + 2 * p2 * x
    u, v = x * factor + p2 * squared, y * factor + p1 * squared
    if coefficients.shape[-1] >= 12:
        s1, s2, s3, s4 = coefficients[..., 8:12].unbind(-1)
        u, v = u + (s1 + s2 * squared) * squared, v + (s3 + s4 * squared) * squared
    return u, v


def jacobian(x: Tensor, y: Tensor, coefficients: Tensor) -> Jacobian:
    """The derivatives of ``distort``.

    Examples:
        >>> jacobian(torch.tensor(1.0), torch.tensor(0.0), torch.tensor([-0.25, 0.0, 0.0, 0.0])).ux.item()  # 1 - 0.75
        0.25
    """
    p1, p2 = coefficients[..., 2], coefficients[..., 3]
    squared = x * x + y * y
    factor, slope = _radial_and_slope(coefficients, squared)
    factor = factor + 2 * p1 * y + 2 * p2 * x
    twice = 2 * slope
    mixed = twice * x * y + 2 * p1 * x + 2 * p2 * y
    ux, uy = factor + x * (twice * x + 4 * p2), mixed
    vx, vy = mixed, factor + y * (twice * y + 4 * p1)
    if coefficients.shape[-1] >= 12:
        s1, s2, s3, s4 = coefficients[..., 8:12].unbind(-1)
        along_u, along_v = 2 * s1 + 4 * s2 * squared, 2 * s3 + 4 * s4 * squared
        ux, uy = ux + x * along_u, uy + y * along_u
        vx, vy = vx + x * along_v, vy + y * along_v
    return Jacobian(ux, uy, vx, vy)


def _angles(coefficients: Tensor, samples: int) -> Tensor:
    end = math.atan(LARGEST_RADIUS)
    return torch.linspace(0, end, samples, dtype=coefficients.dtype, device=coefficients.device)


def radius_limit(coefficients: Tensor, samples: int = 256) -> Tensor:
    """A radius (*) between the first fold of the radial distortion and where it would turn again, or 10⁴.

    Inside of it a positive determinant means one-to-one: together they are the domain of the distortion. Without
    derivatives.
    """
    with torch.no_grad():
        radius = torch.tan(_angles(coefficients, samples))
        squared = radius * radius
        factor, slope = _radial_and_slope(coefficients.unsqueeze(-2), squared)
        folded = ~((factor > 0) & (factor + 2 * squared * slope > 0))
        below = _denominator(coefficients.unsqueeze(-2))
        if below:
            folded = folded | (_one_plus(below, squared) <= 0)
        reached = folded.long().cummax(-1).values
        turned = (reached * (~folded).long()).cummax(-1).values
        middle = (1 - reached).sum(-1) + (reached - turned).sum(-1) // 2
        return torch.where(reached[..., -1] > 0, radius[middle.clamp_max(samples - 1)], LARGEST_RADIUS)


def fold_radius(coefficients: Tensor, samples: int = 256, azimuths: int = 32) -> Tensor:
    """The largest radius (*) at which the distortion is still one-to-one, over all azimuths; 10⁴ where it always is.

    Without derivatives.

    Examples:
        >>> round(fold_radius(torch.tensor([-1 / 3, 0.0, 0.0, 0.0], dtype=torch.float64)).item(), 6)  # r - r³/3
        1.0
    """
    with torch.no_grad():
        turns = torch.arange(azimuths, dtype=coefficients.dtype, device=coefficients.device)
        azimuth = turns.unsqueeze(-1) * (2 * math.pi / azimuths)
        cosine, sine = azimuth.cos(), azimuth.sin()
        coefficients = coefficients[..., None, None, :]
        limit = torch.atan(radius_limit(coefficients))

        def folded(angle: Tensor) -> Tensor:
            radius = torch.tan(angle)
            return ~(jacobian(radius * cosine, radius * sine, coefficients).determinant > 0) | (angle > limit)

        angles = _angles(coefficients, samples)
        good = (~folded(angles)).long().cumprod(-1).sum(-1, keepdim=True)
        low, high = angles[good - 1], angles[good.clamp_max(samples - 1)]
        for _ in range(40):
            middle = (low + high) / 2
            bad = folded(middle)
            low, high = torch.where(bad, low, middle), torch.where(bad, middle, high)
        return torch.tan(low).squeeze(-1).amax(-1)


class Undistorted(NamedTuple):
    """The plane's points and whether they were found."""

    x: Tensor
    y: Tensor
    converged: Tensor


def undistort(u: Tensor, v: Tensor, coefficients: Tensor, iterations: int = 20) -> Undistorted:
    """The plane's points (x, y) whose distorted places are (u, v), each (*): the inverse of ``distort``.

    Newton's method in two dimensions from the centre, in which a step that would not come closer, or would leave the
    region where the distortion is one-to-one, is halved. The search is not recorded by autograd: two Newton steps from
    the solution are, and they carry exact first and second derivatives (implicit function theorem). Where no solution
    was found the last place is returned, without derivatives.

    Examples:
        >>> found = undistort(torch.tensor(0.45), torch.tensor(0.0), torch.tensor([-0.4, 0.0, 0.0, 0.0]))
        >>> round(found.x.item(), 5), found.converged.item()
        (0.5, True)
    """
    with torch.no_grad():
        limit = radius_limit(coefficients).square()
        x, y = torch.zeros_like(u), torch.zeros_like(v)
        step_x, step_y = u, v  # at the centre the Jacobian is the identity
        scale, error = torch.ones_like(u), u * u + v * v
        for _ in range(iterations):
            new_x, new_y = x + scale * step_x, y + scale * step_y
            new_u, new_v = distort(new_x, new_y, coefficients)
            slopes = jacobian(new_x, new_y, coefficients)
            determinant = slopes.determinant
            to_u, to_v = u - new_u, v - new_v
            new_error = to_u * to_u + to_v * to_v
            inside = (determinant > 0) & (new_x * new_x + new_y * new_y <= limit)
            better = (new_error < error) & inside
            x, y = torch.where(better, new_x, x), torch.where(better, new_y, y)
            step_x = torch.where(better, (slopes.vy * to_u - slopes.uy * to_v) / determinant, step_x)
            step_y = torch.where(better, (slopes.ux * to_v - slopes.vx * to_u) / determinant, step_y)
            error = torch.where(better, new_error, error)
            scale = torch.where(better, (2 * scale).clamp_max(1), scale / 2)
        converged = error.sqrt() <= torch.finfo(u.dtype).eps ** 0.75 * (1 + u.abs() + v.abs())
    for _ in range(2):
        now_u, now_v = distort(x, y, coefficients)
        slopes = jacobian(x, y, coefficients)
        determinant = torch.where(converged, slopes.determinant, 1.0)
        from_u, from_v = now_u - u, now_v - v
        x = x - torch.where(converged, (slopes.vy * from_u - slopes.uy * from_v) / determinant, 0.0)
        y = y - torch.where(converged, (slopes.ux * from_v - slopes.vx * from_u) / determinant, 0.0)
    return Undistorted(x, y, converged)
