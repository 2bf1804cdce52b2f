# SPDX-License-Identifier: Apache-2.0
"""The extended unified model: an ellipsoid and a pinhole."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.base import Camera, Projection, Unprojection
from sphericalvision.cameras.fitting.model import FOCAL, FittedModel, fitted
from sphericalvision.cameras.fitting.starts import shape_grid
from sphericalvision.cameras.models.image_plane import (
    IMAGE_PLANE,
    pixels_from_plane,
    plane_from_pixels,
    unit_directions,
)
from sphericalvision.cameras.precision import computed_in_float32
from sphericalvision.cameras.registry import register_camera
from sphericalvision.core import ArgumentError, check_last_dim
from sphericalvision.geometry.directions import components, holds, is_greater, safe_sqrt

__all__ = ["ExtendedUnifiedCamera", "project_extended_unified", "unproject_extended_unified"]


def _widest_cosine(alpha: Tensor) -> Tensor:
    """The smallest z / d: −α / (1 − α) where the denominator vanishes, −(1 − α) / α where the radius turns."""
    beyond = alpha > 0.5
    smaller, larger = torch.where(beyond, 1 - alpha, alpha), torch.where(beyond, alpha, 1 - alpha)
    return -smaller / larger


@computed_in_float32
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
    check_last_dim("points", points, 3)
    x, y, z = components(points)
    squared = torch.addcmul(beta * torch.addcmul(x * x, y, y), z, z)
    length = torch.sqrt(squared.clamp_min(torch.finfo(z.dtype).tiny))
    valid = is_greater(z, _widest_cosine(alpha) * length)
    # Beyond the model's end points land far outside of the image, in place of a division by 0.
    denominator = alpha * length + (1 - alpha) * z
    denominator = torch.maximum(denominator, torch.finfo(z.dtype).eps * length)
    pixels = pixels_from_plane(x / denominator, y / denominator, focal_length, principal_point)
    return Projection(pixels, valid)


@computed_in_float32
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
    check_last_dim("pixels", pixels, 2)
    x, y = plane_from_pixels(pixels, focal_length, principal_point)
    squared = beta * torch.addcmul(x * x, y, y)
    under_root = 1 - (2 * alpha - 1) * squared
    divisor = alpha * safe_sqrt(under_root) + 1 - alpha
    depth = (1 - alpha * alpha * squared) / divisor.clamp_min(torch.finfo(pixels.dtype).eps)
    return Unprojection(unit_directions(x, y, depth), under_root >= 0)


@register_camera
class ExtendedUnifiedCamera(Camera):
    """An extended unified (EUCM) camera, as calibrated by Basalt and Kalibr.

    Args:
        focal_length: (*b, 2) in pixels.
        principal_point: (*b, 2) as (u, v).
        alpha: (*b,) in [0, 1].
        beta: (*b,), above 0.
        image_size: (height, width).
        max_angle: half the field of view in radians, a number or (*b,); by default where the model ends.

    Raises:
        ArgumentError: ``alpha`` outside [0, 1] or ``beta`` not above 0.

    Examples:
        >>> camera = ExtendedUnifiedCamera([191.0, 191.0], [255.5, 255.5], 0.63, 1.04, (512, 512))
        >>> camera.unproject(camera.project(torch.tensor([0.0, 0.6, 0.8])).pixels).directions
        tensor([0.0000, 0.6000, 0.8000])
    """

    model = "extended_unified"
    intrinsic_names: ClassVar[tuple[str, ...]] = ("focal_length", "principal_point", "alpha", "beta")
    sizes: ClassVar[dict[str, tuple[int, ...]]] = {**IMAGE_PLANE, "alpha": (), "beta": ()}

    focal_length: Float[Tensor, "*batch 2"]
    principal_point: Float[Tensor, "*batch 2"]
    alpha: Float[Tensor, "*batch"]
    beta: Float[Tensor, "*batch"]

    def __init__(
        self,
        focal_length: Sequence[float] | Float[Tensor, "*#batch 2"],
        principal_point: Sequence[float] | Float[Tensor, "*#batch 2"],
        alpha: float | Float[Tensor, "*#batch"],
        beta: float | Float[Tensor, "*#batch"],
        image_size: Sequence[int],
        max_angle: float | Float[Tensor, "*#batch"] | None = None,
    ) -> None:
        super().__init__(
            image_size,
            math.pi if max_angle is None else max_angle,
            focal_length=focal_length,
            principal_point=principal_point,
            alpha=alpha,
            beta=beta,
        )
        if not holds((self.alpha >= 0) & (self.alpha <= 1)):
            raise ArgumentError(f"alpha: expected numbers in [0, 1], got {self.alpha.tolist()}")
        if not holds(self.beta > 0):
            raise ArgumentError(f"beta: expected numbers above 0, got {self.beta.tolist()}")
        if max_angle is None:
            self.max_angle = self._widest_angle()

    @torch.no_grad()
    def _widest_angle(self) -> Tensor:
        """On the ellipsoid z is cos and the radius sin / √β of the angle at which the model ends."""
        cosine = _widest_cosine(self.alpha)
        return torch.atan2(safe_sqrt(1 - cosine * cosine) / torch.sqrt(self.beta), cosine)

    def _project(self, points: Tensor) -> Projection:
        return project_extended_unified(points, *self._aligned(points))

    def _unproject(self, pixels: Tensor) -> Unprojection:
        return unproject_extended_unified(pixels, *self._aligned(pixels))


@fitted(ExtendedUnifiedCamera)
def _fitted_model(num_coefficients: int, projection: str) -> FittedModel:
    starts = shape_grid((0.0, 0.3, 0.5, 0.6, 0.7, 0.8), (0.5, 0.8, 1.0, 1.3, 2.0, 4.0))
    bounds = {"alpha": (0.0, 1.0), "beta": (1e-3, 1e3)}
    sizes = FOCAL | {"alpha": None, "beta": None}
    return FittedModel(ExtendedUnifiedCamera, project_extended_unified, sizes, starts, bounds)
