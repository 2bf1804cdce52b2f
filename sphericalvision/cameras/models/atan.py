# SPDX-License-Identifier: Apache-2.0
"""The field-of-view model of Devernay and Faugeras: PTAM's ATAN, COLMAP's FOV."""

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
from sphericalvision.geometry.directions import components, cosine_and_lifted_sinc, holds, lifted_radius

__all__ = ["AtanCamera", "project_atan", "unproject_atan"]


def _slope_of_plane(omega: Tensor) -> Tensor:
    """2 tan(ω / 2), by which tan θ is stretched before the arc tangent."""
    return 2 * torch.tan(omega / 2)


@computed_in_float32
def project_atan(
    points: Float[Tensor, "*#batch 3"],
    focal_length: Float[Tensor, "*#batch 2"],
    principal_point: Float[Tensor, "*#batch 2"],
    omega: Float[Tensor, "*#batch"],
) -> Projection:
    """Pixels (*, 2) of ``points`` (*, 3): the image radius is atan(2 tan(ω/2) tan θ) / ω focal lengths.

    The paper's formula ends at 90° from the axis; ``atan2`` in its place goes on smoothly beyond, up to straight back.

    Args:
        points: (*, 3) in the camera's frame, any length.
        focal_length: (*, 2) in pixels.
        principal_point: (*, 2) as (u, v).
        omega: (*) in radians, the field of view of the ideal lens, in (0, π).

    References:
        F. Devernay, O. Faugeras, "Straight lines have to be straight", Machine Vision and Applications 13
        (2001), eq. 13.

    Examples:
        >>> lens = [torch.tensor(x) for x in ([100.0, 100.0], [320.0, 240.0], 1.0)]
        >>> project_atan(torch.tensor([1.0, 0.0, 0.0]), *lens).pixels.round()  # 90° to the right: π/2 focal lengths
        tensor([477., 240.])
    """
    check_last_dim("points", points, 3)
    x, y, z = components(points)
    radius = lifted_radius(x, y, z)
    angle = torch.atan2(_slope_of_plane(omega) * radius, z)
    scale = angle / (omega * radius)
    pixels = pixels_from_plane(x * scale, y * scale, focal_length, principal_point)
    return Projection(pixels, torch.maximum(radius, z) > 2 * torch.finfo(z.dtype).eps * z.abs())


@computed_in_float32
def unproject_atan(
    pixels: Float[Tensor, "*#batch 2"],
    focal_length: Float[Tensor, "*#batch 2"],
    principal_point: Float[Tensor, "*#batch 2"],
    omega: Float[Tensor, "*#batch"],
) -> Unprojection:
    """Unit directions (*, 3) of ``pixels`` (*, 2): the closed inverse of ``project_atan``, eq. 14.

    Examples:
        >>> lens = [torch.tensor(x) for x in ([100.0, 100.0], [320.0, 240.0], 1.0)]
        >>> unproject_atan(torch.tensor([320.0, 240.0]), *lens).directions.tolist()
        [0.0, 0.0, 1.0]
    """
    check_last_dim("pixels", pixels, 2)
    x, y = plane_from_pixels(pixels, focal_length, principal_point)
    squared = torch.addcmul(x * x, y, y) * (omega * omega)
    cosine, sinc = cosine_and_lifted_sinc(squared)
    scale = sinc * omega / _slope_of_plane(omega)
    return Unprojection(unit_directions(x * scale, y * scale, cosine), squared <= math.pi**2)


@register_camera
class AtanCamera(Camera):
    """A field-of-view (FOV, ATAN) camera, as calibrated by PTAM, DSO, Tango and COLMAP.

    Args:
        focal_length: (*b, 2) in pixels.
        principal_point: (*b, 2) as (u, v).
        omega: (*b,) in radians, in (0, π).
        image_size: (height, width).
        max_angle: half the field of view in radians, a number or (*b,); by default 180°: the image is the
            limit.

    Raises:
        ArgumentError: ``omega`` outside (0, π).

    Examples:
        >>> camera = AtanCamera([255.0, 255.0], [319.5, 239.5], 0.93, (480, 640))
        >>> camera.unproject(camera.project(torch.tensor([0.0, 0.6, 0.8])).pixels).directions
        tensor([0.0000, 0.6000, 0.8000])
    """

    model = "atan"
    intrinsic_names: ClassVar[tuple[str, ...]] = ("focal_length", "principal_point", "omega")
    sizes: ClassVar[dict[str, tuple[int, ...]]] = {**IMAGE_PLANE, "omega": ()}

    focal_length: Float[Tensor, "*batch 2"]
    principal_point: Float[Tensor, "*batch 2"]
    omega: Float[Tensor, "*batch"]

    def __init__(
        self,
        focal_length: Sequence[float] | Float[Tensor, "*#batch 2"],
        principal_point: Sequence[float] | Float[Tensor, "*#batch 2"],
        omega: float | Float[Tensor, "*#batch"],
        image_size: Sequence[int],
        max_angle: float | Float[Tensor, "*#batch"] | None = None,
    ) -> None:
        super().__init__(
            image_size,
            math.pi if max_angle is None else max_angle,
            focal_length=focal_length,
            principal_point=principal_point,
            omega=omega,
        )
        if not holds((self.omega > 0) & (self.omega < math.pi)):
            raise ArgumentError(f"omega: expected radians in (0, π), got {self.omega.tolist()}")

    def _project(self, points: Tensor) -> Projection:
        return project_atan(points, *self._aligned(points))

    def _unproject(self, pixels: Tensor) -> Unprojection:
        return unproject_atan(pixels, *self._aligned(pixels))


@fitted(AtanCamera)
def _fitted_model(num_coefficients: int, projection: str) -> FittedModel:
    starts = shape_grid((0.05, 0.3, 0.6, 0.9, 1.2, 1.6, 2.2))
    bounds = {"omega": (1e-3, 3.1)}
    return FittedModel(AtanCamera, project_atan, FOCAL | {"omega": None}, starts, bounds)
