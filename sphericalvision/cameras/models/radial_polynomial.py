# SPDX-License-Identifier: Apache-2.0
"""The radial polynomial model: the image radius in pixels is any polynomial of the angle from the axis."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.base import Camera, Projection, Unprojection
from sphericalvision.cameras.checks import model_function
from sphericalvision.cameras.declaration import ANY, ImageSize, Intrinsic, MaxAngle
from sphericalvision.cameras.fitting import FittedModel, Samples, fitted, solve_linear
from sphericalvision.cameras.registry import register_camera
from sphericalvision.core import ArgumentError
from sphericalvision.geometry.directions import (
    components,
    cosine_and_lifted_sinc,
    holds,
    lifted_radius,
    unit_directions,
)
from sphericalvision.geometry.rootfinding import (
    increasing_limit,
    polynomial,
    polynomial_value,
    polynomial_with_curvature,
    refine_root,
    samples_towards,
    tabulate_inverse,
)

_SAMPLES = 256


def _radius(coefficients: Tensor, angle: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The radius θ (k1 + k2 θ + ...) and its first two derivatives."""
    value, slope, curvature = polynomial_with_curvature(coefficients, angle)
    return angle * value, torch.addcmul(value, angle, slope), torch.addcmul(2 * slope, angle, curvature)


def _slope(coefficients: Tensor, angle: Tensor) -> Tensor:
    value, slope = polynomial(coefficients, angle)
    return torch.addcmul(value, angle, slope)


def _widest_angle(coefficients: Tensor) -> Tensor:
    """The angle (*) in [0, π] up to which the radius grows."""
    end = torch.full_like(coefficients[..., 0], math.pi)
    return increasing_limit(lambda angle: _slope(coefficients.unsqueeze(-2), angle), end, _SAMPLES)


def _start(coefficients: Tensor, widest: Tensor, target: Tensor) -> Tensor:
    """The angle (*) of the radius ``target`` (*), to some digits, from a table."""
    with torch.no_grad():
        angles = samples_towards(widest)
        radii = angles * polynomial_value(coefficients.unsqueeze(-2), angles)
        first = coefficients[..., 0]  # r / (k1 + r) keeps the table fine near the centre
        return tabulate_inverse(angles, radii / (first.unsqueeze(-1) + radii)).lookup(
            target / (first + target)
        )


@model_function
def project_radial_polynomial(
    points: Float[Tensor, "*#batch 3"],
    coefficients: Float[Tensor, "*#batch k"],
    principal_point: Float[Tensor, "*#batch 2"],
    aspect_ratio: Float[Tensor, "*#batch"],
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
    x, y, z = components(points)
    radius = lifted_radius(x, y, z)
    angle = torch.atan2(radius, z)
    scale = angle * polynomial_value(coefficients, angle) / radius
    u = x * scale + principal_point[..., 0]
    v = y * scale * aspect_ratio + principal_point[..., 1]
    valid = (angle <= _widest_angle(coefficients)) & (angle < math.pi)
    return Projection(torch.stack((u, v), dim=-1), valid)


@model_function
def unproject_radial_polynomial(
    pixels: Float[Tensor, "*#batch 2"],
    coefficients: Float[Tensor, "*#batch k"],
    principal_point: Float[Tensor, "*#batch 2"],
    aspect_ratio: Float[Tensor, "*#batch"],
) -> Unprojection:
    """Unit directions (*, 3) of ``pixels`` (*, 2), by Newton's method on the angle; past 90° too.

    The arguments are those of ``project_radial_polynomial``.

    Examples:
        >>> lens = [torch.tensor(x) for x in ([200.0, 0.0, -10.0], [320.0, 240.0], 1.0)]
        >>> unproject_radial_polynomial(torch.tensor([320.0, 240.0]), *lens).directions.tolist()
        [0.0, 0.0, 1.0]
    """
    u, v = components(pixels)
    x, y = u - principal_point[..., 0], (v - principal_point[..., 1]) / aspect_ratio
    target = torch.sqrt(torch.addcmul(x * x, y, y) + torch.finfo(x.dtype).eps ** 2)
    widest = _widest_angle(coefficients)
    largest = widest * polynomial_value(coefficients, widest)
    inside = target <= largest * (1 + 16 * torch.finfo(target.dtype).eps)
    target = torch.minimum(target, largest.detach())
    start = _start(coefficients, widest, target.detach())
    angle, converged = refine_root(lambda angle: _radius(coefficients, angle), target, start, widest)
    cosine, sinc = cosine_and_lifted_sinc(angle * angle)
    scale = sinc / polynomial_value(coefficients, angle)
    return Unprojection(unit_directions(x * scale, y * scale, cosine), converged & inside)


@register_camera
class RadialPolynomialCamera(Camera):
    """A camera whose image radius is a polynomial of the angle from the axis: WoodScape, and Aria's radial part.

    See ``project_radial_polynomial``, whose coefficients are ``polynomial``.

    Examples:
        >>> camera = RadialPolynomialCamera([339.7, -32.0, 48.3, -7.2], [643.4, 479.1], 1.0, (966, 1280))
        >>> camera.unproject(camera.project(torch.tensor([0.0, 0.96, -0.28])).pixels).directions
        tensor([ 0.0000,  0.9600, -0.2800])
    """

    model = "radial_polynomial"
    functions = project_radial_polynomial, unproject_radial_polynomial

    polynomial: Intrinsic = Intrinsic(ANY)
    principal_point: Intrinsic = Intrinsic(2)
    aspect_ratio: Intrinsic = Intrinsic(above=0)
    image_size: ImageSize = ImageSize()
    max_angle: MaxAngle = MaxAngle(default=None)

    def _check_intrinsics(self) -> None:
        super()._check_intrinsics()
        if self.polynomial.ndim == 0 or not holds(self.polynomial[..., 0] > 0):
            raise ArgumentError(
                "polynomial: expected coefficients (*, k) of θ, θ², ... in pixels, the first above 0, got "
                f"{self.polynomial.tolist()}"
            )

    def _model_end(self) -> Tensor:
        return _widest_angle(self.polynomial)

    def _scaled(self, scale: tuple[float, float]) -> dict[str, Tensor]:
        s, t = scale
        return {"polynomial": self.polynomial * s, "aspect_ratio": self.aspect_ratio * (t / s)}


def _power_start(model: FittedModel, samples: Samples) -> list[Tensor]:
    """Radial polynomial: the radius in pixels along u is linear in the coefficients."""
    angle = samples.angle
    powers = torch.stack([angle**power for power in range(1, (model.sizes["polynomial"] or 0) + 1)], dim=-1)
    coefficients = solve_linear(powers, samples.radius * samples.focal_length[0])
    aspect = samples.focal_length[1:] / samples.focal_length[:1]
    intrinsics = {"polynomial": coefficients, "principal_point": samples.center, "aspect_ratio": aspect}
    return [model.vector(intrinsics)]


fitted(RadialPolynomialCamera, _power_start, num_coefficients=(4, 1, 2, 3, *range(5, 13)))
