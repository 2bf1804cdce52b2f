# SPDX-License-Identifier: Apache-2.0
"""The Kannala-Brandt model: with four coefficients OpenCV's fisheye, Kalibr's equidistant, Basalt's kb4."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.base import Projection, Unprojection
from sphericalvision.cameras.declaration import ImageSize, Intrinsic, MaxAngle, OptionalIntrinsic
from sphericalvision.cameras.fitting.model import FittedModel, Samples, fitted
from sphericalvision.cameras.fitting.starts import with_shapes
from sphericalvision.cameras.models.image_plane import (
    PlaneCamera,
    pixels_from_plane,
    plane_from_pixels,
    unit_directions,
)
from sphericalvision.cameras.models.odd_polynomial import (
    radial_solution,
    squared_radius,
    tabulated,
    widest_angle,
)
from sphericalvision.cameras.precision import model_function
from sphericalvision.cameras.registry import register_camera
from sphericalvision.geometry.directions import components, cosine_and_lifted_sinc, lifted_radius
from sphericalvision.geometry.rootfinding import (
    polynomial_value,
    refine_root,
    with_leading_one,
)

__all__ = ["KannalaBrandtCamera", "project_kannala_brandt", "unproject_kannala_brandt"]


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
    functions = project_kannala_brandt, unproject_kannala_brandt

    distortion: Intrinsic = Intrinsic(*range(1, 10), named="k1 k2 k3 k4 k5 k6 k7 k8 k9")
    image_size: ImageSize = ImageSize()
    max_angle: MaxAngle = MaxAngle(default=None)
    skew: OptionalIntrinsic = OptionalIntrinsic(default=None)

    def _model_end(self) -> Tensor:
        return widest_angle(with_leading_one(self.distortion))


def _radial_start(model: FittedModel, samples: Samples) -> list[Tensor]:
    """Kannala-Brandt: radius − θ = k1 θ³ + k2 θ⁵ + ... is linear."""
    size = model.sizes["distortion"] or 0
    return [
        torch.cat((samples.focal_length, samples.center, radial_solution(samples, size))),
        *with_shapes(model, samples, [[0.0] * size]),
    ]


fitted(KannalaBrandtCamera, _radial_start, num_coefficients=(4, 1, 2, 3, 5, 6, 7, 8, 9))
