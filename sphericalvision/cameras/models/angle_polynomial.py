# SPDX-License-Identifier: Apache-2.0
"""The angle polynomial model: the angle from the axis is any polynomial of the image radius."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.base import Projection, Unprojection
from sphericalvision.cameras.checks import model_function
from sphericalvision.cameras.declaration import ANY, ImageSize, Intrinsic, MaxAngle
from sphericalvision.cameras.fitting import FittedModel, Samples, fitted, solve_linear
from sphericalvision.cameras.models.image_plane import PlaneCamera, pixels_from_plane, plane_from_pixels
from sphericalvision.cameras.models.radial_polynomial import _radius, _start
from sphericalvision.cameras.registry import register_camera
from sphericalvision.geometry.directions import (
    components,
    cosine_and_lifted_sinc,
    lifted_radius,
    unit_directions,
)
from sphericalvision.geometry.rootfinding import (
    increasing_limit,
    polynomial_value,
    refine_root,
    with_leading_one,
)

MAX_RADIUS = 8.0
"""In focal lengths; a tangent ends here at 83°, twice the tangent of the half angle at 152°."""


def _widest_radius(coefficients: Tensor) -> Tensor:
    """The radius (*) up to which the angle grows, and is below π."""
    coefficients = coefficients.unsqueeze(-2)

    def goes_on(radius: Tensor) -> Tensor:
        angle, slope, _ = _radius(coefficients, radius)
        return torch.minimum(slope, math.pi - angle)

    return increasing_limit(goes_on, torch.full_like(coefficients[..., 0, 0], MAX_RADIUS), 256, 6)


def _angle(coefficients: Tensor, radius: Tensor) -> Tensor:
    return radius * polynomial_value(coefficients, radius)


@model_function
def project_angle_polynomial(
    points: Float[Tensor, "*#batch 3"],
    focal_length: Float[Tensor, "*#batch 2"],
    principal_point: Float[Tensor, "*#batch 2"],
    distortion: Float[Tensor, "*#batch k"],
) -> Projection:
    """Pixels (*, 2) of ``points`` (*, 3): at the image radius ρ, in focal lengths, θ = ρ (1 + k1 ρ + k2 ρ² + ...).

    The radius is found from the angle by Halley's method. Valid up to where the angle stops growing with the radius,
    reaches 180°, or the radius eight focal lengths.

    Args:
        points: (*, 3) in the camera's frame, any length.
        focal_length: (*, 2) in pixels.
        principal_point: (*, 2) as (u, v).
        distortion: (*, k) as (k1, ..., kk).

    Examples:
        >>> lens = [torch.tensor(x) for x in ([200.0, 200.0], [320.0, 240.0], [0.0, 0.05])]
        >>> project_angle_polynomial(torch.tensor([0.0, 0.0, 1.0]), *lens).pixels.tolist()
        [320.0, 240.0]
    """
    x, y, z = components(points)
    radius = lifted_radius(x, y, z)
    target = torch.atan2(radius, z)
    coefficients = with_leading_one(distortion)
    widest = _widest_radius(coefficients)
    largest = _angle(coefficients, widest).detach()
    inside = (target <= largest * (1 + 16 * torch.finfo(target.dtype).eps)) & (target < math.pi)
    target = torch.minimum(target, largest)
    start = _start(coefficients, widest, target.detach())
    root, converged = refine_root(lambda rho: _radius(coefficients, rho), target, start, widest)
    scale = root / radius
    return Projection(
        pixels_from_plane(x * scale, y * scale, focal_length, principal_point), converged & inside
    )


@model_function
def unproject_angle_polynomial(
    pixels: Float[Tensor, "*#batch 2"],
    focal_length: Float[Tensor, "*#batch 2"],
    principal_point: Float[Tensor, "*#batch 2"],
    distortion: Float[Tensor, "*#batch k"],
) -> Unprojection:
    """Unit directions (*, 3) of ``pixels`` (*, 2), by the polynomial; the arguments are those of the projection.

    Examples:
        >>> lens = [torch.tensor(x) for x in ([200.0, 200.0], [320.0, 240.0], [0.0, 0.05])]
        >>> unproject_angle_polynomial(torch.tensor([320.0, 240.0]), *lens).directions.tolist()
        [0.0, 0.0, 1.0]
    """
    x, y = plane_from_pixels(pixels, focal_length, principal_point)
    coefficients = with_leading_one(distortion)
    widest = _widest_radius(coefficients)
    radius = torch.sqrt(torch.addcmul(x * x, y, y) + torch.finfo(x.dtype).eps ** 2)
    inside = radius <= widest * (1 + 16 * torch.finfo(x.dtype).eps)
    shape = polynomial_value(coefficients, torch.minimum(radius, widest))
    angle = torch.minimum(radius, widest) * shape
    cosine, sinc = cosine_and_lifted_sinc(angle * angle)
    return Unprojection(unit_directions(x * sinc * shape, y * sinc * shape, cosine), inside)


@register_camera
class AnglePolynomialCamera(PlaneCamera):
    """Camera whose polynomial goes from the image radius to the angle: Blender's fisheye, NVIDIA's f-theta.

    See ``project_angle_polynomial``.

    Examples:
        >>> camera = AnglePolynomialCamera([200.0, 200.0], [319.5, 239.5], [0.0, 0.02], (480, 640))
        >>> camera.unproject(camera.project(torch.tensor([0.0, 0.96, -0.28])).pixels).directions
        tensor([ 0.0000,  0.9600, -0.2800])
    """

    model = "angle_polynomial"
    functions = project_angle_polynomial, unproject_angle_polynomial

    distortion: Intrinsic = Intrinsic(ANY)
    image_size: ImageSize = ImageSize()
    max_angle: MaxAngle = MaxAngle(default=None)

    def _model_end(self) -> Tensor:
        coefficients = with_leading_one(self.distortion.detach())
        return _angle(coefficients, _widest_radius(coefficients)).clamp_max(math.pi)


def _power_start(model: FittedModel, samples: Samples) -> list[Tensor]:
    """The angle less the radius is linear in the coefficients."""
    radius = samples.radius
    powers = torch.stack([radius ** (k + 2) for k in range(model.sizes["distortion"] or 0)], dim=-1)
    coefficients = solve_linear(powers, samples.angle - radius)
    intrinsics = {"focal_length": samples.focal_length, "principal_point": samples.center}
    return [model.vector(intrinsics | {"distortion": coefficients})]


fitted(AnglePolynomialCamera, _power_start, num_coefficients=(4, 1, 2, 3, *range(5, 10)))
