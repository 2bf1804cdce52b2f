# SPDX-License-Identifier: Apache-2.0
"""The extended unified model: an ellipsoid and a pinhole."""

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


def _widest_cosine(alpha: Tensor) -> Tensor:
    """The smallest z / d: −α / (1 − α) where the denominator vanishes, −(1 − α) / α where the radius turns."""
    is_bounded = alpha > 0.5
    smaller, larger = torch.where(is_bounded, 1 - alpha, alpha), torch.where(is_bounded, alpha, 1 - alpha)
    return -smaller / larger


@model_function
def project_extended_unified(
    points: Float[Tensor, "*#batch 3"],
    focal_length: Float[Tensor, "*#batch 2"],
    principal_point: Float[Tensor, "*#batch 2"],
    alpha: Float[Tensor, "*#batch"],
    beta: Float[Tensor, "*#batch"],
) -> Projection:
    """Pixels (*, 2) of ``points`` (*, 3) through an ellipsoid and a pinhole.

    The plane's point is (x, y) / (α d + (1 − α) z) with d² = β (x² + y²) + z². Valid for z > −w d with
    w = α / (1 − α) up to α = 1/2 and (1 − α) / α beyond, where the radius stops growing.

    Args:
        points: (*, 3) in the camera's frame, any length.
        focal_length: (*, 2) in pixels, that of the image centre.
        principal_point: (*, 2) as (u, v).
        alpha: (*) in [0, 1].
        beta: (*), above 0; with 1 it is the unified model of ξ = α / (1 − α) and γ = f (1 + ξ).

    References:
        B. Khomutenko, G. Garcia, P. Martinet, "An enhanced unified camera model", RA-L 1 (2016); in this form with its
        domain V. Usenko, N. Demmel, D. Cremers, "The double sphere camera model", 3DV 2018, section II-C.

    Examples:
        >>> intrinsics = [torch.tensor(x) for x in ([200.0, 200.0], [320.0, 240.0], 0.5, 1.0)]
        >>> project_extended_unified(torch.tensor([1.0, 0.0, 0.0]), *intrinsics).pixels.tolist()  # 90° to the right
        [720.0, 240.0]
    """
    x, y, z = components(points)
    squared = torch.addcmul(beta * torch.addcmul(x * x, y, y), z, z)
    length = torch.sqrt(squared.clamp_min(torch.finfo(z.dtype).tiny))
    valid = z > _widest_cosine(alpha) * length
    # Beyond the model's end points land far outside of the image, in place of a division by 0.
    denominator = alpha * length + (1 - alpha) * z
    denominator = torch.maximum(denominator, torch.finfo(z.dtype).eps * length)
    pixels = pixels_from_plane(x / denominator, y / denominator, focal_length, principal_point)
    return Projection(pixels, valid)


@model_function
def unproject_extended_unified(
    pixels: Float[Tensor, "*#batch 2"],
    focal_length: Float[Tensor, "*#batch 2"],
    principal_point: Float[Tensor, "*#batch 2"],
    alpha: Float[Tensor, "*#batch"],
    beta: Float[Tensor, "*#batch"],
) -> Unprojection:
    """Unit directions (*, 3) of ``pixels`` (*, 2): the closed inverse of ``project_extended_unified``.

    Examples:
        >>> intrinsics = [torch.tensor(x) for x in ([200.0, 200.0], [320.0, 240.0], 0.5, 1.0)]
        >>> unproject_extended_unified(torch.tensor([720.0, 240.0]), *intrinsics).directions.tolist()
        [1.0, 0.0, 0.0]
    """
    x, y = plane_from_pixels(pixels, focal_length, principal_point)
    squared = beta * torch.addcmul(x * x, y, y)
    under_root = 1 - (2 * alpha - 1) * squared
    divisor = alpha * safe_sqrt(under_root) + 1 - alpha
    depth = (1 - alpha * alpha * squared) / divisor.clamp_min(torch.finfo(pixels.dtype).eps)
    return Unprojection(unit_directions(x, y, depth), under_root >= 0)


@register_camera
class ExtendedUnifiedCamera(PlaneCamera):
    """An extended unified (EUCM) camera, as calibrated by Basalt and Kalibr; see ``project_extended_unified``.

    Examples:
        >>> camera = ExtendedUnifiedCamera([191.0, 191.0], [255.5, 255.5], 0.63, 1.04, (512, 512))
        >>> camera.unproject(camera.project(torch.tensor([0.0, 0.6, 0.8])).pixels).directions
        tensor([0.0000, 0.6000, 0.8000])
    """

    model = "extended_unified"
    functions = project_extended_unified, unproject_extended_unified

    alpha: Intrinsic = Intrinsic(least=0, most=1)
    beta: Intrinsic = Intrinsic(above=0)
    image_size: ImageSize = ImageSize()
    max_angle: MaxAngle = MaxAngle(default=None)

    @torch.no_grad()
    def _model_end(self) -> Tensor:
        """On the ellipsoid z is cos and the radius sin / √β of the angle at which the model ends."""
        cosine = _widest_cosine(self.alpha)
        return torch.atan2(safe_sqrt(1 - cosine * cosine) / torch.sqrt(self.beta), cosine)


fitted(
    ExtendedUnifiedCamera,
    shape_grid((0.0, 0.3, 0.5, 0.6, 0.7, 0.8), (0.5, 0.8, 1.0, 1.3, 2.0, 4.0)),
    bounds={"alpha": (0.0, 1.0), "beta": (1e-3, 1e3)},
)
