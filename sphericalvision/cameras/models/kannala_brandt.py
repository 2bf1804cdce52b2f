# SPDX-License-Identifier: Apache-2.0
"""The Kannala-Brandt model: with four coefficients OpenCV's fisheye, Kalibr's equidistant, Basalt's kb4.

Its radial part is the odd polynomial θ g(θ²) with g(s) = 1 + k1 s + k2 s² + ...; ``coefficients`` (*, k + 1) are those
of g, the leading 1 included.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.base import Projection, Unprojection
from sphericalvision.cameras.checks import model_function
from sphericalvision.cameras.declaration import ImageSize, Intrinsic, MaxAngle, OptionalIntrinsic
from sphericalvision.cameras.fitting import FittedModel, Samples, fitted, solve_linear, with_shapes
from sphericalvision.cameras.models.image_plane import PlaneCamera, pixels_from_plane, plane_from_pixels
from sphericalvision.cameras.registry import register_camera
from sphericalvision.geometry.directions import (
    components,
    cosine_and_lifted_sinc,
    lifted_radius,
    unit_directions,
)
from sphericalvision.geometry.rootfinding import (
    InverseTable,
    increasing_limit,
    polynomial,
    polynomial_value,
    polynomial_with_curvature,
    refine_root,
    samples_towards,
    tabulate_inverse,
    with_leading_one,
)


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
    bound = (1 + most).sqrt()
    return squared_radius / (1 + squared_radius) + squared_radius / (bound + squared_radius)


def tabulated(coefficients: Float[Tensor, "*batch k"], widest: Float[Tensor, "*batch"]) -> Inverse:
    """The inverse up to the angle ``widest`` (*)."""
    with torch.no_grad():
        angle = samples_towards(widest)
        squared = angle * angle
        squared_radius = squared * polynomial_value(coefficients.unsqueeze(-2), squared).square()
        most = squared_radius[..., -1:]
        return Inverse(tabulate_inverse(squared, _spread(squared_radius, most)), most.squeeze(-1))


@model_function
def project_kannala_brandt(
    points: Float[Tensor, "*#batch 3"],
    focal_length: Float[Tensor, "*#batch 2"],
    principal_point: Float[Tensor, "*#batch 2"],
    distortion: Float[Tensor, "*#batch k"],
) -> Projection:
    """Pixels (*, 2) of ``points`` (*, 3): the image radius is θ + k1 θ³ + k2 θ⁵ + ... focal lengths.

    θ is the angle from the axis, so the model reaches past 90°. Valid up to the angle where the radius stops growing.

    Args:
        points: (*, 3) in the camera's frame, any length.
        focal_length: (*, 2) in pixels.
        principal_point: (*, 2) as (u, v).
        distortion: (*, k) as (k1, ..., kk), any number of coefficients, mostly four.

    References:
        J. Kannala, S. Brandt, "A generic camera model and calibration method for conventional, wide-angle, and fish-eye
        lenses", PAMI 28 (2006), eq. 6.

    Examples:
        >>> ideal = [torch.tensor(x) for x in ([100.0, 100.0], [320.0, 240.0], [0.0, 0.0, 0.0, 0.0])]
        >>> project_kannala_brandt(torch.tensor([0.0, 0.0, 1.0]), *ideal).pixels.tolist()
        [320.0, 240.0]
    """
    coefficients = with_leading_one(distortion)
    x, y, z = components(points)
    radius = lifted_radius(x, y, z)
    angle = torch.atan2(radius, z)
    scale = angle * polynomial_value(coefficients, angle * angle) / radius
    pixels = pixels_from_plane(x * scale, y * scale, focal_length, principal_point)
    return Projection(pixels, angle <= widest_angle(coefficients))


@model_function
def unproject_kannala_brandt(
    pixels: Float[Tensor, "*#batch 2"],
    focal_length: Float[Tensor, "*#batch 2"],
    principal_point: Float[Tensor, "*#batch 2"],
    distortion: Float[Tensor, "*#batch k"],
) -> Unprojection:
    """Unit directions (*, 3) of ``pixels`` (*, 2), by Halley's method on the squared angle; past 90° too.

    The squared radius is a polynomial of the squared angle, which keeps all derivatives exact at the principal point.
    The arguments are those of ``project_kannala_brandt``.

    Examples:
        >>> ideal = [torch.tensor(x) for x in ([100.0, 100.0], [320.0, 240.0], [0.0, 0.0, 0.0, 0.0])]
        >>> unproject_kannala_brandt(torch.tensor([320.0, 240.0]), *ideal).directions.tolist()
        [0.0, 0.0, 1.0]
    """
    coefficients = with_leading_one(distortion)
    x, y = plane_from_pixels(pixels, focal_length, principal_point)
    target = torch.addcmul(x * x, y, y)
    widest = widest_angle(coefficients)
    inverse = tabulated(coefficients, widest)
    inside = target <= inverse.most * (1 + 16 * torch.finfo(target.dtype).eps)
    target = torch.minimum(target, inverse.most)
    squared, converged = refine_root(
        lambda squared: squared_radius(coefficients, squared),
        target,
        inverse.lookup(target.detach()),
        widest * widest,
    )
    cosine, sinc = cosine_and_lifted_sinc(squared.clamp_min(0))
    scale = sinc / polynomial_value(coefficients, squared)
    return Unprojection(unit_directions(x * scale, y * scale, cosine), converged & inside)


@register_camera
class KannalaBrandtCamera(PlaneCamera):
    """A Kannala-Brandt camera of up to nine coefficients, correct past 90°; see ``project_kannala_brandt``.

    With four coefficients OpenCV's fisheye and Kalibr's equidistant; ``skew`` is the second number of OpenCV's matrix.

    Examples:
        >>> camera = KannalaBrandtCamera([190.0, 190.0], [255.0, 257.0], [0.003, 0.0, -0.002, 0.0], (512, 512), 1.7)
        >>> camera.unproject(camera.project(torch.tensor([0.6, 0.0, 0.8])).pixels).directions
        tensor([0.6000, 0.0000, 0.8000])
    """

    model = "kannala_brandt"
    is_endless = True
    functions = project_kannala_brandt, unproject_kannala_brandt

    distortion: Intrinsic = Intrinsic(*range(1, 10), named="k1 k2 k3 k4 k5 k6 k7 k8 k9")
    image_size: ImageSize = ImageSize()
    max_angle: MaxAngle = MaxAngle(default=None)
    skew: OptionalIntrinsic = OptionalIntrinsic(default=None)

    def _model_end(self) -> Tensor:
        return widest_angle(with_leading_one(self.distortion))


def radial_starts(model: FittedModel, samples: Samples) -> list[Tensor]:
    """From radius − θ = k1 θ³ + k2 θ⁵ + ..., which is linear, and from no distortion; terms behind these are 0."""
    size, angle = model.sizes["distortion"] or 0, samples.angle
    powers = torch.stack([angle ** (2 * k + 3) for k in range(size)], dim=-1)
    radial = solve_linear(powers, samples.radius - angle)
    others = sum(size or 1 for size in model.sizes.values()) - 4 - size
    return [
        torch.cat((samples.focal_length, samples.center, radial, radial.new_zeros(others))),
        *with_shapes(model, samples, [[0.0] * (size + others)]),
    ]


fitted(KannalaBrandtCamera, radial_starts, num_coefficients=(4, 1, 2, 3, 5, 6, 7, 8, 9))
