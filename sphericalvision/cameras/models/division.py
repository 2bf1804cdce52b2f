# SPDX-License-Identifier: Apache-2.0
"""The division model: undistorted = distorted / (1 + λ1 r² + λ2 r⁴ + ...), with any number of parameters."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.base import Projection, Unprojection
from sphericalvision.cameras.checks import model_function
from sphericalvision.cameras.declaration import ImageSize, Intrinsic, MaxAngle
from sphericalvision.cameras.fitting import FittedModel, Samples, fitted, solve_linear, with_shapes
from sphericalvision.cameras.models.image_plane import PlaneCamera, pixels_from_plane, plane_from_pixels
from sphericalvision.cameras.models.ocam import _inverse_table, _scale_by_root
from sphericalvision.cameras.registry import register_camera
from sphericalvision.geometry.directions import components, unit_directions
from sphericalvision.geometry.rootfinding import increasing_limit, polynomial, with_leading_one


def _direct_polynomial(distortion: Tensor) -> Tensor:
    """Of an OCam lens of focal length 1, −(1 + λ1 ρ² + λ2 ρ⁴ + ...): the two models are one but for odd powers."""
    odd = torch.zeros_like(distortion)
    even = with_leading_one(distortion)
    return -torch.cat((torch.stack((even[..., :-1], odd), -1).flatten(-2), even[..., -1:]), dim=-1)


def _turn(coefficients: Tensor, squared: Tensor) -> tuple[Tensor, Tensor]:
    """z of the ray of image radius ρ, from ρ², and what has the sign of the angle's derivative."""
    z, slope = polynomial(coefficients, squared)
    return z, torch.addcmul(z, squared, slope, value=-2)


def _for_each_camera(max_radius: Tensor | float, distortion: Tensor) -> Tensor:
    """A radius (*) for each set of coefficients."""
    return torch.as_tensor(max_radius).to(distortion) + torch.zeros_like(distortion[..., 0])


def _widest_radius(coefficients: Tensor, max_radius: Tensor) -> Tensor:
    """The image radius (*) up to which larger radii mean larger angles, at most ``max_radius`` (*)."""
    coefficients = coefficients.unsqueeze(-2)
    return increasing_limit(lambda rho: _turn(coefficients, rho * rho)[1], max_radius, samples=256)


@model_function
def project_division(
    points: Float[Tensor, "*#batch 3"],
    focal_length: Float[Tensor, "*#batch 2"],
    principal_point: Float[Tensor, "*#batch 2"],
    distortion: Float[Tensor, "*#batch k"],
    max_radius: Float[Tensor, "*#batch"] | float = 10.0,
) -> Projection:
    """Pixels (*, 2) of ``points`` (*, 3): the inverse of ``unproject_division``, by Halley's method; past 90° too.

    Args:
        points: (*, 3) in the camera's frame, any length.
        focal_length: (*, 2) in pixels.
        principal_point: (*, 2) as (u, v).
        distortion: (*, k) as (λ1, ..., λk), of radii in focal lengths; a λ1 below 0 is a barrel.
        max_radius: (*), largest image radius in focal lengths that is looked at.

    References:
        A. Fitzgibbon, "Simultaneous linear estimation of multiple view geometry and lens distortion", CVPR 2001 (one
        parameter); V. Larsson et al., "Revisiting radial distortion absolute pose", ICCV 2019 (several).

    Examples:
        >>> lens = [torch.tensor(x) for x in ([100.0, 100.0], [320.0, 240.0], [-0.25])]
        >>> project_division(torch.tensor([1.0, 0.0, 0.0]), *lens).pixels  # 1 - r²/4 is 0 at two focal lengths
        tensor([520., 240.])
    """
    x, y, z = components(points)
    limit = _for_each_camera(max_radius, distortion)
    scale, valid = _scale_by_root(x, y, z, _direct_polynomial(distortion), limit)
    return Projection(pixels_from_plane(x * scale, y * scale, focal_length, principal_point), valid)


@model_function
def unproject_division(
    pixels: Float[Tensor, "*#batch 2"],
    focal_length: Float[Tensor, "*#batch 2"],
    principal_point: Float[Tensor, "*#batch 2"],
    distortion: Float[Tensor, "*#batch k"],
    max_radius: Float[Tensor, "*#batch"] | float = 10.0,
) -> Unprojection:
    """Unit directions (*, 3) of ``pixels`` (*, 2): along (x, y, 1 + λ1 r² + λ2 r⁴ + ...), (x, y) in focal lengths.

    Valid up to the radius at which the angle from the axis stops growing. The arguments are ``project_division``'s.

    Examples:
        >>> lens = [torch.tensor(x) for x in ([100.0, 100.0], [320.0, 240.0], [-0.25])]
        >>> unproject_division(torch.tensor([520.0, 240.0]), *lens).directions.tolist()
        [1.0, 0.0, 0.0]
    """
    x, y = plane_from_pixels(pixels, focal_length, principal_point)
    squared = torch.addcmul(x * x, y, y)
    coefficients = with_leading_one(distortion)
    z, _ = _turn(coefficients, squared)
    limit = _for_each_camera(max_radius, distortion)
    widest = _widest_radius(coefficients, limit) * (1 + 16 * torch.finfo(z.dtype).eps)
    return Unprojection(unit_directions(x, y, z), squared <= widest * widest)


@register_camera
class DivisionCamera(PlaneCamera):
    """A division camera of up to six parameters, past 90° where they lead there; see ``project_division``.

    By default its view ends at the farthest corner of the image, or where the angle stops growing before.

    Examples:
        >>> camera = DivisionCamera([300.0, 300.0], [319.5, 239.5], [-0.3], (480, 640))
        >>> camera.unproject(camera.project(torch.tensor([0.0, 0.6, 0.8])).pixels).directions
        tensor([0.0000, 0.6000, 0.8000])
    """

    model = "division"
    functions = project_division, unproject_division

    distortion: Intrinsic = Intrinsic(*range(1, 7), named="k1 k2 k3 k4 k5 k6")
    image_size: ImageSize = ImageSize()
    max_angle: MaxAngle = MaxAngle(default=None)

    def _model_end(self) -> Tensor:
        direct = _direct_polynomial(self.distortion.detach())
        return _inverse_table(direct, self._max_radius(self.distortion)).limit

    def _max_radius(self, values: Tensor) -> Tensor:
        """An image radius (*) in focal lengths beyond the farthest corner."""
        height, width = self.image_size
        u, v = self._align(self.principal_point, values).unbind(-1)
        focal_u, focal_v = self._align(self.focal_length, values).unbind(-1)
        corner = torch.hypot(torch.maximum(u, width - u) / focal_u, torch.maximum(v, height - v) / focal_v)
        return 1.05 * corner.detach()

    def _arguments(self, values: Tensor) -> list[Any]:
        return [*super()._arguments(values), self._max_radius(values)]


def _linear_start(model: FittedModel, samples: Samples) -> list[Tensor]:
    """Division: radius cot θ − 1 = λ1 r² + λ2 r⁴ + ... is linear, weighted by sin θ."""
    size, sine = model.sizes["distortion"] or 0, samples.angle.sin()
    powers = torch.stack([samples.radius ** (2 * k) for k in range(1, size + 1)], dim=-1)
    solution = solve_linear(powers * sine.unsqueeze(-1), samples.radius * samples.angle.cos() - sine)
    return [
        torch.cat((samples.focal_length, samples.center, solution)),
        *with_shapes(model, samples, [[value, *[0.0] * (size - 1)] for value in (0.0, -0.1, -0.25, -0.5)]),
    ]


fitted(DivisionCamera, _linear_start, num_coefficients=(2, 1, 3, 4, 5, 6))
