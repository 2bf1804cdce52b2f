# SPDX-License-Identifier: Apache-2.0
"""Radial, tangential and thin prism distortion of the normalised image plane, its Jacobian, limit and inverse.

Shared by the Brown-Conrady and the unified model. Coefficients (*, k) are in OpenCV's order, k1 k2 p1 p2 k3 k4 k5 k6
s1 s2 s3 s4, cut off after 4, 5, 8 or 12; leading dimensions broadcast with the coordinates (*).

With r² = x² + y², the radial factor g = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶), g' = dg/dr² and
A = g + 2 p1 y + 2 p2 x::

    u = A x + p2 r² + s1 r² + s2 r⁴        v = A y + p1 r² + s3 r² + s4 r⁴

    ┌ ux uy ┐   ┌ A + 2 g' x² + 4 p2 x          2 g' x y + 2 p1 x + 2 p2 y ┐     ┌ x (s1 + 2 s2 r²)  y (s1 + 2 s2 r²) ┐
    └ vx vy ┘ = └ 2 g' x y + 2 p1 x + 2 p2 y    A + 2 g' y² + 4 p1 y       ┘ + 2 └ x (s3 + 2 s4 r²)  y (s3 + 2 s4 r²) ┘

In code r² is ``squared``, g ``radial``, its denominator ``divisor``, g' ``slope`` and A ``factor``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, addcmul

from sphericalvision.geometry.rootfinding import increasing_limit, tabulate_inverse

LARGEST_RADIUS = 1e4  # tan(89.994°): its eighth power still fits into float32
_SAMPLES = 256  # at equal angles, 0.35° apart
_STEP = math.atan(LARGEST_RADIUS) / (_SAMPLES - 1)


class Distorted(NamedTuple):
    """Distorted places, and what the Jacobian has in common with them; each (*)."""

    u: Tensor
    v: Tensor
    squared: Tensor
    """r² of the undistorted place."""
    radial: Tensor
    """Its radial factor g(r²)."""
    divisor: Tensor | None
    """The denominator of g, for rational distortion."""
    factor: Tensor
    """g + 2 p1 y + 2 p2 x."""


class Jacobian(NamedTuple):
    """Derivatives (*) of the distorted (u, v) with respect to the plane's (x, y)."""

    ux: Tensor
    uy: Tensor
    vx: Tensor
    vy: Tensor

    @property
    def determinant(self) -> Float[Tensor, " ..."]:
        """Positive where the distortion keeps orientation, and so is one-to-one near by."""
        return addcmul(self.ux * self.vy, self.uy, self.vx, value=-1)


class Undistorted(NamedTuple):
    """The plane's points (x, y) and whether they were found; each (*)."""

    x: Tensor
    y: Tensor
    converged: Tensor


def distort(
    x: Float[Tensor, " ..."],
    y: Float[Tensor, " ..."],
    coefficients: Float[Tensor, "*coefficients k"],
    largest: Float[Tensor, " ..."] | None = None,
) -> Distorted:
    """The distorted (u, v), each (*), of the plane's points (x, y); r² counts as ``largest`` (*) where it is more.

    Examples:
        >>> distorted = distort(torch.tensor(0.5), torch.tensor(0.0), torch.tensor([-0.4, 0.0, 0.0, 0.0]))
        >>> round(distorted.u.item(), 6)  # 0.5 (1 - 0.4 · 0.25)
        0.45
    """
    p1, p2 = coefficients[..., 2], coefficients[..., 3]
    squared = addcmul(x * x, y, y)
    # Polynomials turn back far outside; a bounded r² keeps those points outside instead of on top of the image.
    if largest is not None:
        squared = torch.minimum(squared, largest)
    radial, divisor = _radial(coefficients, squared)
    factor = addcmul(addcmul(radial, 2 * p1, y), 2 * p2, x)
    u, v = addcmul(x * factor, p2, squared), addcmul(y * factor, p1, squared)
    if coefficients.shape[-1] >= 12:
        s1, s2, s3, s4 = coefficients[..., 8:12].unbind(-1)
        u = addcmul(u, addcmul(s1, s2, squared), squared)
        v = addcmul(v, addcmul(s3, s4, squared), squared)
    return Distorted(u, v, squared, radial, divisor, factor)


def distort_inside(
    x: Float[Tensor, " ..."],
    y: Float[Tensor, " ..."],
    coefficients: Float[Tensor, "*coefficients k"],
    largest_radius: Float[Tensor, " ..."] | None = None,
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Bool[Tensor, "*batch"]]:
    """Distorted (u, v), and where the distortion is one-to-one; each (*).

    Looked at up to ``largest_radius`` (*), at most ``radius_limit``, which it is by default. Beyond it r² counts as its
    square, so that places farther out stay farther out.

    Examples:
        >>> x, zero = torch.tensor([0.5, 5.0]), torch.tensor([0.0, 0.0])
        >>> u, v, one_to_one = distort_inside(x, zero, torch.tensor([-0.25, 0.0, 0.0, 0.0]))
        >>> u[0].item(), one_to_one.tolist()
        (0.46875, [True, False])
    """
    limit = (radius_limit(coefficients) if largest_radius is None else largest_radius).square()
    x, y = x.clamp(-LARGEST_RADIUS, LARGEST_RADIUS), y.clamp(-LARGEST_RADIUS, LARGEST_RADIUS)
    distorted = distort(x, y, coefficients, limit)
    with torch.no_grad():
        one_to_one = _determinant(x, y, distorted, coefficients) > 0
        return distorted.u, distorted.v, one_to_one & (limit > distorted.squared)


def _determinant(x: Tensor, y: Tensor, distorted: Distorted, coefficients: Tensor) -> Tensor:
    """The sign of the Jacobian's determinant, with less work than ``jacobian`` without thin prism distortion.

    The determinant is A (3 A − 2 (g − r² g')) − 4 (p1 x − p2 y)², as 2 p1 y + 2 p2 x = A − g. A third of it has the
    same sign and one multiplication less.
    """
    if coefficients.shape[-1] >= 12:
        return jacobian(x, y, distorted, coefficients).determinant
    p1, p2 = coefficients[..., 2], coefficients[..., 3]
    slope = _radial_slope(coefficients, distorted)
    straight = addcmul(distorted.radial, slope, distorted.squared, value=-1)
    across = addcmul(p1 * x, p2, y, value=-1)
    along = distorted.factor.sub(straight, alpha=2 / 3)
    return addcmul(along * distorted.factor, across, across, value=-4 / 3)


def jacobian(
    x: Float[Tensor, " ..."],
    y: Float[Tensor, " ..."],
    distorted: Distorted,
    coefficients: Float[Tensor, "*coefficients k"],
) -> Jacobian:
    """The derivatives of ``distort`` at (x, y), from what it returned there.

    Examples:
        >>> one, zero, coefficients = torch.tensor(1.0), torch.tensor(0.0), torch.tensor([-0.25, 0.0, 0.0, 0.0])
        >>> jacobian(one, zero, distort(one, zero, coefficients), coefficients).ux.item()  # 1 - 0.75
        0.25
    """
    p1, p2 = coefficients[..., 2], coefficients[..., 3]
    squared, factor = distorted.squared, distorted.factor
    twice = 2 * _radial_slope(coefficients, distorted)
    along = twice * x  # 2 g' x, which both rows need
    mixed = addcmul(addcmul(2 * p1 * x, 2 * p2, y), along, y)
    ux, uy = addcmul(factor, x, along + 4 * p2), mixed
    vx, vy = mixed, addcmul(factor, y, addcmul(4 * p1, twice, y))
    if coefficients.shape[-1] >= 12:
        s1, s2, s3, s4 = coefficients[..., 8:12].unbind(-1)
        along_u, along_v = addcmul(2 * s1, 4 * s2, squared), addcmul(2 * s3, 4 * s4, squared)
        ux, uy = addcmul(ux, x, along_u), addcmul(uy, y, along_u)
        vx, vy = addcmul(vx, x, along_v), addcmul(vy, y, along_v)
    return Jacobian(ux, uy, vx, vy)


def radius_limit(coefficients: Float[Tensor, "*batch k"]) -> Float[Tensor, "*batch"]:
    """A radius (*) between the first fold of the radial distortion and where it would turn again, or 10⁴.

    Inside of it a positive determinant means one-to-one: together they are the domain of the distortion. Without
    derivatives.
    """
    with torch.no_grad():
        growing, upright = (signs.to(coefficients) for signs in _radial_signs(coefficients))
        # Halfway between the first fold and the next turn: there the determinant alone tells inside from outside,
        # and rounding near either of them does not matter.
        before = growing.cumprod(-1)  # 1 up to the first fold
        until = torch.cummax(upright * (1 - before), -1).values  # 1 from where it turns again
        center = (_SAMPLES + (before - until).sum(-1)) / 2
        return torch.where(before[..., -1] > 0, LARGEST_RADIUS, torch.tan(center * _STEP))


def fold_radius(coefficients: Float[Tensor, "*batch k"]) -> Float[Tensor, "*batch"]:
    """The largest radius (*) at which the distortion is still one-to-one, over 32 azimuths; 10⁴ where it always is.

    Without derivatives.

    Examples:
        >>> round(fold_radius(torch.tensor([-1 / 3, 0.0, 0.0, 0.0])).item(), 3)  # r - r³/3
        1.0
    """
    with torch.no_grad():
        angles = torch.arange(32, dtype=coefficients.dtype, device=coefficients.device)
        azimuth = angles.unsqueeze(-1) * (2 * math.pi / len(angles))
        limit = torch.atan(radius_limit(coefficients))[..., None, None]
        coefficients = coefficients[..., None, None, :]

        def determinant(angle: Tensor) -> Tensor:
            x, y = torch.tan(angle) * azimuth.cos(), torch.tan(angle) * azimuth.sin()
            slopes = jacobian(x, y, distort(x, y, coefficients), coefficients)
            # The limit itself is inside, whatever rounding makes of its angle.
            return torch.where(angle <= limit + 1e-6, slopes.determinant, -1.0)

        # By angle, not by radius: a search up to 10⁴ in equal steps of the radius would skip the image.
        end = torch.full((*coefficients.shape[:-3], len(angles)), math.atan(LARGEST_RADIUS)).to(azimuth)
        return torch.tan(increasing_limit(determinant, end, _SAMPLES)).amax(-1)


def undistort(
    u: Float[Tensor, "*batch"], v: Float[Tensor, "*batch"], coefficients: Float[Tensor, "*coefficients k"]
) -> Undistorted:
    """The plane's points (x, y) whose distorted places are (u, v), each (*): the inverse of ``distort``.

    Newton's method in two dimensions from a table of the radial part. A step that would leave the region where the
    distortion is one-to-one is halved. The search is not recorded by autograd: two Newton steps from the solution are,
    and they carry exact first and second derivatives (implicit function theorem). Where no solution was found the last
    place is returned, without derivatives.

    There are 10 steps, and 18 in float64: at a fold each step only halves what is missing.

    Examples:
        >>> found = undistort(torch.tensor(0.45), torch.tensor(0.0), torch.tensor([-0.4, 0.0, 0.0, 0.0]))
        >>> round(found.x.item(), 5), found.converged.item()
        (0.5, True)
    """
    iterations = 18 if u.dtype == torch.float64 else 10
    with torch.no_grad():
        limit = radius_limit(coefficients).square()
        start = _radial_start(u.detach(), v.detach(), coefficients.detach())  # also forward

    def place(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Jacobian]:
        distorted = distort(x, y, coefficients)
        return distorted.u, distorted.v, jacobian(x, y, distorted, coefficients)

    def inside(x: Tensor, y: Tensor) -> Tensor:
        return addcmul(x * x, y, y) <= limit

    return invert_plane_map(place, u, v, start, inside, iterations)


def invert_plane_map(
    function: Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Jacobian]],
    u: Float[Tensor, "*batch"],
    v: Float[Tensor, "*batch"],
    start: tuple[Tensor, Tensor],
    inside: Callable[[Tensor, Tensor], Tensor] | None = None,
    iterations: int = 10,
) -> Undistorted:
    """The plane's points (x, y) that ``function`` maps to (u, v), each (*), by Newton's method in two dimensions.

    Args:
        function: maps (x, y) to (u, v) and the derivatives there; 0 near by 0.
        u: wanted places (*).
        v: wanted places (*).
        start: (x, y), each (*), to some digits.
        inside: where (x, y) may be at all; everywhere by default. A step that would leave it, or the region in which
            the function keeps orientation, is halved.
        iterations: steps that autograd does not record; two more are recorded.
    """
    with torch.no_grad():
        # The centre is always inside. The start is its first step, which is halved as any other one if it leads out.
        x, y = torch.zeros_like(u), torch.zeros_like(v)
        step_x, step_y = start
        for _ in range(iterations):
            new_x, new_y = x + step_x, y + step_y
            new_u, new_v, slopes = function(new_x, new_y)
            determinant = slopes.determinant
            allowed = determinant > 0
            if inside is not None:
                allowed = allowed & inside(new_x, new_y)
            newton_x, newton_y = _newton_step(u - new_u, v - new_v, slopes, determinant)
            x, y = torch.where(allowed, new_x, x), torch.where(allowed, new_y, y)
            step_x = torch.where(allowed, newton_x, step_x / 2)
            step_y = torch.where(allowed, newton_y, step_y / 2)
    # A recorded Newton step from the solution has the derivative of the inverse, and a second one the second
    # derivative. Where none was found both are masked before the division, so that no NaN comes back in gradients.
    converged = torch.zeros_like(u, dtype=torch.bool)
    for recorded in range(2):
        new_u, new_v, slopes = function(x, y)
        to_u, to_v = u - new_u, v - new_v
        if recorded == 0:
            converged = _two_steps_suffice(to_u, to_v, u, v)
        determinant = torch.where(converged, slopes.determinant, 1.0)
        newton_x, newton_y = _newton_step(to_u, to_v, slopes, determinant)
        x = x + torch.where(converged, newton_x, 0.0)
        y = y + torch.where(converged, newton_y, 0.0)
    return Undistorted(x, y, converged)


def _two_steps_suffice(to_u: Tensor, to_v: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Whether two more Newton steps make (u, v) exact, which is (to_u, to_v) away."""
    # Each step squares the relative error: the first leaves eps^1.5, which is less than rounding.
    return to_u.abs() + to_v.abs() <= torch.finfo(u.dtype).eps ** 0.75 * (1 + u.abs() + v.abs())


def _newton_step(u: Tensor, v: Tensor, slopes: Jacobian, determinant: Tensor) -> tuple[Tensor, Tensor]:
    """The Jacobian's inverse times (u, v)."""
    x = addcmul(slopes.vy * u, slopes.uy, v, value=-1) / determinant
    y = addcmul(slopes.ux * v, slopes.vx, u, value=-1) / determinant
    return x, y


def _radial_start(u: Tensor, v: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor]:
    """The solution (x, y) were there no tangential and thin prism distortion, to some digits."""
    # As many samples as there are before the fold are spread anew up to it: beyond it the table would not be monotonic.
    growing = _radial_signs(coefficients)[0].to(u).cumprod(-1).sum(-1, keepdim=True)
    radius = torch.tan((growing - 1).clamp_min(1) / (_SAMPLES - 1) * _angles(coefficients))
    radial, _ = _radial(coefficients.unsqueeze(-2), radius * radius)
    table = tabulate_inverse(radius, torch.atan(radius * radial))
    target = torch.hypot(u, v)
    ratio = table.lookup(torch.atan(target)) / target.clamp_min(torch.finfo(u.dtype).tiny)
    return u * ratio, v * ratio


def _radial_signs(coefficients: Tensor) -> tuple[Tensor, Tensor]:
    """At radii up to 10⁴ at equal angles (*, n): where the radial distortion grows, and where it keeps orientation.

    It keeps orientation also where it falls and has passed the centre, and may where it has passed a pole.
    """
    coefficients = coefficients.unsqueeze(-2)
    squared = torch.tan(_angles(coefficients)).square()
    radial, divisor = _radial(coefficients, squared)
    slope = _radial_slope(coefficients, Distorted(radial, radial, squared, radial, divisor, radial))
    # The distorted radius is r g, whose derivative g + 2 r² g' is ``rising``; g < 0 is beyond the centre.
    outwards, rising = radial > 0, radial + 2 * squared * slope > 0
    growing = outwards & rising if divisor is None else outwards & rising & (divisor > 0)
    return growing, outwards == rising


def _angles(coefficients: Tensor) -> Tensor:
    end = (_SAMPLES - 1) * _STEP
    return torch.linspace(0, end, _SAMPLES, dtype=coefficients.dtype, device=coefficients.device)


def _radial(coefficients: Tensor, squared: Tensor) -> tuple[Tensor, Tensor | None]:
    """The factor g(r²) of the radial distortion and its denominator, if it has one."""
    factor = _one_plus(_numerator(coefficients), squared)
    below = _denominator(coefficients)
    if not below:
        return factor, None
    divisor = _one_plus(below, squared)
    return factor / divisor, divisor


def _radial_slope(coefficients: Tensor, distorted: Distorted) -> Tensor:
    """The derivative of g with respect to r²."""
    slope = _slope(_numerator(coefficients), distorted.squared)
    if distorted.divisor is None:
        return slope
    below = _slope(_denominator(coefficients), distorted.squared)
    return addcmul(slope, distorted.radial, below, value=-1) / distorted.divisor


def _numerator(coefficients: Tensor) -> list[Tensor]:
    """k1, k2 and, where present, k3."""
    return [coefficients[..., index] for index in (0, 1, 4) if index < coefficients.shape[-1]]


def _denominator(coefficients: Tensor) -> list[Tensor]:
    """k4, k5, k6 where present."""
    return [coefficients[..., index] for index in range(5, min(coefficients.shape[-1], 8))]


def _one_plus(terms: list[Tensor], squared: Tensor) -> Tensor:
    """1 + t1 s + t2 s² + ..."""
    value = (squared * terms[-1]).add_(terms[-2])  # of two single numbers addcmul takes longer
    for term in reversed(terms[:-2]):
        value = addcmul(term, value, squared)
    return (value * squared).add_(1)


def _slope(terms: list[Tensor], squared: Tensor) -> Tensor:
    """Derivative t1 + 2 t2 s + 3 t3 s² + ... of ``_one_plus``."""
    weighted = [power * term for power, term in enumerate(terms, start=1)]
    value = (squared * weighted[-1]).add_(weighted[-2])
    for term in reversed(weighted[:-2]):
        value = addcmul(term, value, squared)
    return value
