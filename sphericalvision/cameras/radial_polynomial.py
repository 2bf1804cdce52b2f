# SPDX-License-Identifier: Apache-2.0
"""The radial polynomial model: the image radius in pixels is any polynomial of the angle from the axis."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor

from sphericalvision.cameras.base import Camera, Projection, Unprojection
from sphericalvision.core import ArgumentError, check_last_dim
from sphericalvision.geometry import (
    angle_over_radius,
    cosine_and_sinc,
    normalize,
    polynomial,
    safe_hypot,
    solve_increasing,
)

__all__ = ["RadialPolynomialCamera", "project_radial_polynomial", "unproject_radial_polynomial"]

_SAMPLES = 256


def _slope(coefficients: Tensor, angle: Tensor) -> Tensor:
    """Derivative of the radius θ (k1 + k2 θ + ...)."""
    value, derivative = polynomial(coefficients, angle)
    return value + angle * derivative


def _widest_angle(coefficients: Tensor) -> Tensor:
    """The angle (*) in (0, π] up to which the radius grows: the first of 256 steps that falls, then bisection."""
    with torch.no_grad():
        angles = torch.linspace(0, math.pi, _SAMPLES, dtype=coefficients.dtype, device=coefficients.device)
        growing = (_slope(coefficients.unsqueeze(-2), angles) > 0).long().cumprod(-1).sum(-1)
        low, high = angles[(growing - 1).clamp_min(0)], angles[growing.clamp_max(_SAMPLES - 1)]
        for _ in range(24):
            middle = (low + high) / 2
            grows = _slope(coefficients, middle) > 0
            low, high = torch.where(grows, middle, low), torch.where(grows, high, middle)
        return torch.where(growing == _SAMPLES, math.pi, low)


def project_radial_polynomial(
    points: Tensor, coefficients: Tensor, principal_point: Tensor, aspect_ratio: Tensor
) -> Projection:
    """Pixels (*, 2) of ``points`` (*, 3): the image radius is k1 θ + k2 θ² + ... pixels at the angle θ from the axis.

    Valid up to the angle where the radius stops growing. The backward axis, which has no azimuth, is not valid.

    Args:
        points: (*, 3) in the camera's frame, any length.
        coefficients: (*, k) as (k1, ..., kk) in pixels.
        principal_point: (*, 2) as (u, v).
        aspect_ratio: (*), the radius along v over that along u.

    References:
        S. Yogamani et al., "WoodScape: a multi-task, multi-camera fisheye dataset for autonomous driving", ICCV 2019,
        section 3.1 (fourth degree).

    Examples:
        >>> lens = [torch.tensor(x) for x in ([200.0, 0.0, -10.0], [320.0, 240.0], 1.0)]
        >>> project_radial_polynomial(torch.tensor([0.0, 0.0, 1.0]), *lens).pixels.tolist()
        [320.0, 240.0]
    """
    check_last_dim("points", points, 3)
    over_radius = angle_over_radius(points)
    angle = over_radius * safe_hypot(points[..., 0], points[..., 1])
    scale = over_radius * polynomial(coefficients, angle)[0]
    scales = torch.stack((scale, scale * aspect_ratio), dim=-1)
    valid = (angle <= _widest_angle(coefficients)) & (over_radius > 0)
    return Projection(points[..., :2] * scales + principal_point, valid)


def unproject_radial_polynomial(
    pixels: Tensor, coefficients: Tensor, principal_point: Tensor, aspect_ratio: Tensor
) -> Unprojection:
    """Unit directions (*, 3) of ``pixels`` (*, 2), by Newton's method on the angle; past 90° too.

    The arguments are those of ``project_radial_polynomial``.

    Examples:
        >>> lens = [torch.tensor(x) for x in ([200.0, 0.0, -10.0], [320.0, 240.0], 1.0)]
        >>> unproject_radial_polynomial(torch.tensor([320.0, 240.0]), *lens).directions.tolist()
        [0.0, 0.0, 1.0]
    """
    check_last_dim("pixels", pixels, 2)

    def radius(angle: Tensor) -> tuple[Tensor, Tensor]:
        value, derivative = polynomial(coefficients, angle)
        return angle * value, value + angle * derivative

    u, v = (pixels - principal_point).unbind(-1)
    v = v / aspect_ratio
    target = safe_hypot(u, v)
    widest = _widest_angle(coefficients)
    angle, converged = solve_increasing(
        radius, target, torch.zeros_like(widest), widest, start=(target / coefficients[..., 0]).detach()
    )
    cosine, sinc = cosine_and_sinc(angle * angle)
    scale = sinc / polynomial(coefficients, angle)[0]
    return Unprojection(normalize(torch.stack((u * scale, v * scale, cosine), dim=-1)), converged)


class RadialPolynomialCamera(Camera):
    """A camera whose image radius is a polynomial of the angle from the axis: WoodScape, and Aria's radial part.

    Args:
        polynomial: (*b, k) as (k1, ..., kk), the radius in pixels being k1 θ + k2 θ² + ...
        principal_point: (*b, 2) as (u, v).
        aspect_ratio: (*b,), the radius along v over that along u.
        image_size: (height, width).
        max_angle: half the field of view in radians, a number or (*b,); by default where the radius stops growing.

    Raises:
        ArgumentError: a first coefficient or an aspect ratio that is not above 0.

    Examples:
        >>> camera = RadialPolynomialCamera([339.7, -32.0, 48.3, -7.2], [643.4, 479.1], 1.0, (966, 1280))
        >>> camera.unproject(camera.project(torch.tensor([0.0, 0.96, -0.28])).pixels).directions
        tensor([ 0.0000,  0.9600, -0.2800])
    """

    model = "radial_polynomial"
    intrinsic_names: ClassVar[tuple[str, ...]] = ("polynomial", "principal_point", "aspect_ratio")

    polynomial: Tensor
    principal_point: Tensor
    aspect_ratio: Tensor

    def __init__(
        self,
        polynomial: Sequence[float] | Tensor,
        principal_point: Sequence[float] | Tensor,
        aspect_ratio: float | Tensor,
        image_size: Sequence[int],
        max_angle: float | Tensor | None = None,
    ) -> None:
        super().__init__(
            image_size,
            math.pi if max_angle is None else max_angle,
            polynomial=polynomial,
            principal_point=principal_point,
            aspect_ratio=aspect_ratio,
        )
        check_last_dim("principal_point", self.principal_point, 2)
        if self.polynomial.ndim == 0 or not bool((self.polynomial[..., 0] > 0).all()):
            raise ArgumentError(
                "polynomial: expected coefficients (*, k) of θ, θ², ... in pixels, the first above 0, got "
                f"{self.polynomial.tolist()}"
            )
        if not bool((self.aspect_ratio > 0).all()):
            raise ArgumentError(f"aspect_ratio: expected numbers above 0, got {self.aspect_ratio.tolist()}")
        batch = self.principal_point.shape[:-1]
        self.aspect_ratio = self.aspect_ratio.expand(batch)
        if max_angle is None:
            self.max_angle = _widest_angle(self.polynomial)
        self._set_batch(*batch)

    def _project(self, points: Tensor) -> Projection:
        return project_radial_polynomial(points, *self._aligned(points))

    def _unproject(self, pixels: Tensor) -> Unprojection:
        return unproject_radial_polynomial(pixels, *self._aligned(pixels))
