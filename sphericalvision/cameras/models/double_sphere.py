# SPDX-License-Identifier: Apache-2.0
"""The double sphere model."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.base import Projection, Unprojection
from sphericalvision.cameras.checks import model_function
from sphericalvision.cameras.declaration import ImageSize, Intrinsic, MaxAngle
from sphericalvision.cameras.fitting import fitted, shape_grid
from sphericalvision.cameras.models.image_plane import PlaneCamera, pixels_from_plane, plane_from_pixels
from sphericalvision.cameras.registry import register_camera
from sphericalvision.geometry.directions import components, safe_sqrt, unit_directions


def _widest_cosine(xi: Tensor, alpha: Tensor) -> Tensor:
    """Minus the cosine of the angle at which the model ends, w2 of eq. 43."""
    w1 = torch.where(alpha <= 0.5, alpha / (1 - alpha).clamp_min(1e-9), (1 - alpha) / alpha.clamp_min(1e-9))
    return (w1 + xi) / safe_sqrt(2 * w1 * xi + xi * xi + 1)


@model_function
def project_double_sphere(
    points: Float[Tensor, "*#batch 3"],
    focal_length: Float[Tensor, "*#batch 2"],
    principal_point: Float[Tensor, "*#batch 2"],
    xi: Float[Tensor, "*#batch"],
    alpha: Float[Tensor, "*#batch"],
) -> Projection:
    """Pixels (*, 2) of ``points`` (*, 3) through two spheres and a pinhole.

    Args:
        points: (*, 3) in the camera's frame, any length.
        focal_length: (*, 2) in pixels.
        principal_point: (*, 2) as (u, v).
        xi: (*), distance of the spheres' centres.
        alpha: (*) in [0, 1].

    References:
        V. Usenko, N. Demmel, D. Cremers, "The double sphere camera model", 3DV 2018, eqs. 40-45.

    Examples:
        >>> intrinsics = [torch.tensor(x) for x in ([200.0, 200.0], [320.0, 240.0], -0.2, 0.6)]
        >>> project_double_sphere(torch.tensor([0.0, 0.0, 1.0]), *intrinsics).pixels.tolist()
        [320.0, 240.0]
    """
    limits = torch.finfo(points.dtype)
    x, y, z = components(points)
    # So that roots have derivatives at the camera's centre
    squared = torch.addcmul(x * x, y, y) + limits.tiny**0.5
    first = torch.addcmul(squared, z, z).sqrt()
    shifted = torch.addcmul(z, xi, first)
    second = torch.addcmul(squared, shifted, shifted).sqrt()
    denominator = torch.addcmul(alpha * second, 1 - alpha, shifted)
    least = limits.eps * first
    shrink = torch.maximum(denominator, least).reciprocal()
    valid = (denominator > least) & (z > -_widest_cosine(xi, alpha) * first)
    return Projection(pixels_from_plane(x * shrink, y * shrink, focal_length, principal_point), valid)


@model_function
def unproject_double_sphere(
    pixels: Float[Tensor, "*#batch 2"],
    focal_length: Float[Tensor, "*#batch 2"],
    principal_point: Float[Tensor, "*#batch 2"],
    xi: Float[Tensor, "*#batch"],
    alpha: Float[Tensor, "*#batch"],
) -> Unprojection:
    """Unit directions (*, 3) of ``pixels`` (*, 2): the closed inverse of ``project_double_sphere``, eqs. 46-50.

    Examples:
        >>> intrinsics = [torch.tensor(x) for x in ([200.0, 200.0], [320.0, 240.0], -0.2, 0.6)]
        >>> unproject_double_sphere(torch.tensor([320.0, 240.0]), *intrinsics).directions.tolist()
        [0.0, 0.0, 1.0]
    """
    x, y = plane_from_pixels(pixels, focal_length, principal_point)
    squared = torch.addcmul(x * x, y, y)
    under_root = 1 - (2 * alpha - 1) * squared
    depth = (1 - alpha * alpha * squared) / (alpha * safe_sqrt(under_root) + 1 - alpha).clamp_min(1e-9)
    length = depth * depth + squared
    scale = (depth * xi + safe_sqrt(depth * depth + (1 - xi * xi) * squared)) / length
    return Unprojection(unit_directions(x * scale, y * scale, scale * depth - xi), under_root >= 0)


@register_camera
class DoubleSphereCamera(PlaneCamera):
    """A double sphere camera, as calibrated by Basalt and Kalibr; see ``project_double_sphere``.

    Examples:
        >>> camera = DoubleSphereCamera([200.0, 200.0], [319.5, 239.5], -0.2, 0.6, (480, 640), 1.7)
        >>> camera.unproject(camera.project(torch.tensor([0.0, 0.6, 0.8])).pixels).directions
        tensor([0.0000, 0.6000, 0.8000])
    """

    model = "double_sphere"
    is_endless = True
    functions = project_double_sphere, unproject_double_sphere

    xi: Intrinsic = Intrinsic(above=-1, below=1)
    alpha: Intrinsic = Intrinsic(least=0, most=1)
    image_size: ImageSize = ImageSize()
    max_angle: MaxAngle = MaxAngle(default=None)

    def _model_end(self) -> Tensor:
        return torch.acos(-_widest_cosine(self.xi, self.alpha)).detach()


fitted(
    DoubleSphereCamera,
    shape_grid((-0.4, -0.2, 0.0, 0.2, 0.5, 0.8), (0.0, 0.3, 0.5, 0.6, 0.7, 0.8)),
    bounds={"xi": (-0.999, 0.999), "alpha": (0.0, 1.0)},
)
