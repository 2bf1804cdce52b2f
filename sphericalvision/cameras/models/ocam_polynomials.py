# SPDX-License-Identifier: Apache-2.0
"""Linear least squares fits of each polynomial of an OCam camera to the other."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.base import check_single
from sphericalvision.cameras.field_of_view import directions_around_axis, visible_angle
from sphericalvision.cameras.fitting import solve_linear
from sphericalvision.cameras.models.ocam import OCamCamera
from sphericalvision.core import ArgumentError
from sphericalvision.geometry.rootfinding import polynomial

_HIGHEST_DEGREE = 17  # beyond it float64 has no digits left for the powers


class InverseFit(NamedTuple):
    """An OCam camera with a fitted inverse polynomial."""

    camera: OCamCamera
    residual: float
    """Largest distance in pixels between its projections and those of the exact inverse, over the field of view."""


@torch.no_grad()
def fit_inverse_polynomial(
    camera: OCamCamera, degree: int | None = None, tolerance: float = 0.01
) -> InverseFit:
    """Fit the inverse polynomial of an OCam camera to its direct one, over what the camera sees.

    The coefficients are those of OCamCalib's files: ascending powers of the angle from the image plane,
    ``atan2(−z, hypot(x, y))``, giving the image radius in pixels.

    Args:
        camera: a single camera; an inverse polynomial that it has is not looked at.
        degree: of the polynomial; by default the smallest whose residual is within ``tolerance``, or the best up to 17.
        tolerance: pixels.

    Raises:
        ArgumentError: the camera is a batch, or ``degree`` is not from 1 to 17.

    References:
        D. Scaramuzza, A. Martinelli, R. Siegwart, "A toolbox for easily calibrating omnidirectional
        cameras", IROS 2006; ``findinvpoly`` of the toolbox.

    Examples:
        >>> camera = OCamCamera([-100.0, 0.0, 0.0025], None, [319.5, 239.5], [1.0, 0.0, 0.0], (480, 640), 1.9)
        >>> fitted, residual = fit_inverse_polynomial(camera)
        >>> residual < 0.01, fitted.inverse_polynomial.shape
        (True, torch.Size([8]))
    """
    check_single(camera)
    if degree is not None and not 1 <= degree <= _HIGHEST_DEGREE:
        raise ArgumentError(f"degree: expected 1 to {_HIGHEST_DEGREE}, got {degree}")
    exact = camera.exact().to(torch.float64)
    azimuth = torch.arange(360, dtype=torch.float64, device=camera.device) * (math.pi / 180)
    widest = visible_angle(exact, azimuth).max()
    best = InverseFit(camera, math.inf)
    if not widest > 0:
        raise ArgumentError(f"camera: this {camera!r} sees nothing around its axis")
    angle, radius = _profile(exact, widest)
    steps = torch.linspace(0, 1, 1001, dtype=torch.float64, device=camera.device) * (1 - 1e-9)
    points = directions_around_axis(steps * widest, azimuth[::15, None])
    expected = exact.project(points)
    for number in [degree] if degree is not None else range(1, _HIGHEST_DEGREE + 1):
        fitted = camera._with_inverse(fit_inverse(angle, radius, number).to(camera.polynomial))
        gap = (fitted.project(points).pixels - expected.pixels).norm(dim=-1)
        residual = float(gap[expected.valid].max())
        if residual < best.residual:
            best = InverseFit(fitted, residual)
        if residual <= tolerance:
            break
    return best


def _profile(camera: OCamCamera, widest: Tensor) -> tuple[Tensor, Tensor]:
    """Angles from the axis and image radii (n,) of the direct polynomial, from the axis out to ``widest``."""
    radius = torch.linspace(0, 1, 8193, dtype=torch.float64, device=camera.device)
    radius = radius * camera._max_radius(radius.unsqueeze(-1))
    angle = torch.atan2(radius, -polynomial(camera.polynomial, radius)[0])
    outside = (angle >= widest).nonzero()
    last = int(outside[0]) + 1 if len(outside) else len(radius)
    return angle[:last], radius[:last]


def fit_inverse(angle: Float[Tensor, " n"], radius: Float[Tensor, " n"], degree: int) -> Float[Tensor, " k"]:
    """Ascending coefficients of the image radius (n,) in the angle from the image plane, ``angle`` (n,) − π/2."""
    theta = (angle - math.pi / 2).cpu().numpy()
    # Powers would be all but dependent
    fit = np.polynomial.Chebyshev.fit(theta, radius.cpu().numpy(), degree)
    coefficients = fit.convert(kind=np.polynomial.Polynomial).coef
    return torch.as_tensor(coefficients, dtype=radius.dtype, device=radius.device)


def fit_direct(angle: Float[Tensor, " n"], radius: Float[Tensor, " n"]) -> Float[Tensor, " k"]:
    """Coefficients a0, 0, a2, ... of the direct polynomial f with ``tan(angle) = −radius / f(radius)``, (n,) each.

    Of the smallest degree whose error in the image is within a thousandth of a pixel, or the best up to 17.
    """
    # On the axis the tangent vanishes, and with it all that could be learned; a fitted radius may miss 0 there.
    off_axis = (radius > 1e-6 * radius.max()) & (angle > 1e-4)
    angle, radius = angle[off_axis], radius[off_axis]
    largest = radius.max()
    # A change of f by 1 turns the ray by sin²(angle) / radius, and moves its image by so many pixels:
    pixels_per_unit = torch.sin(angle) ** 2 / radius * torch.gradient(radius, spacing=(angle,))[0]
    target = -radius * torch.cos(angle) / torch.sin(angle)
    best, least = target.new_zeros(1), math.inf
    for degree in range(2, _HIGHEST_DEGREE + 1):
        power = torch.tensor([0, *range(2, degree + 1)], dtype=angle.dtype, device=angle.device)
        basis = (radius.unsqueeze(-1) / largest) ** power
        solution = solve_linear(basis * pixels_per_unit.unsqueeze(-1), target * pixels_per_unit)
        error = float(((basis @ solution - target) * pixels_per_unit).abs().max())
        if error < least:
            scaled = solution / largest**power
            best, least = torch.cat((scaled[:1], scaled.new_zeros(1), scaled[1:])), error
        if least <= 1e-3:
            break
    return best
