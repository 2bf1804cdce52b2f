# SPDX-License-Identifier: Apache-2.0
"""The field-of-view model of Devernay and Faugeras: PTAM's ATAN, COLMAP's FOV."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.base import Projection, Unprojection
from sphericalvision.cameras.checks import model_function
from sphericalvision.cameras.declaration import ImageSize, Intrinsic, MaxAngle
from sphericalvision.cameras.fitting import fitted, shape_grid
from sphericalvision.cameras.models.image_plane import PlaneCamera, pixels_from_plane, plane_from_pixels
from sphericalvision.cameras.registry import register_camera
from sphericalvision.geometry.directions import (
    components,
    cosine_and_lifted_sinc,
    lifted_radius,
    unit_directions,
)


def _slope_of_plane(omega: Tensor) -> Tensor:
    """2 tan(ω / 2), by which tan θ is stretched before the arc tangent."""
    return 2 * torch.tan(omega / 2)


@model_function
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
    x, y, z = components(points)
    radius = lifted_radius(x, y, z)
    angle = torch.atan2(_slope_of_plane(omega) * radius, z)
    scale = angle / (omega * radius)
    pixels = pixels_from_plane(x * scale, y * scale, focal_length, principal_point)
    # Not on the backward axis, where the azimuth is rounding.
    return Projection(pixels, torch.maximum(radius, z) > 2 * torch.finfo(z.dtype).eps * z.abs())


@model_function
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
    x, y = plane_from_pixels(pixels, focal_length, principal_point)
    squared = torch.addcmul(x * x, y, y) * (omega * omega)
    cosine, sinc = cosine_and_lifted_sinc(squared)
    scale = sinc * omega / _slope_of_plane(omega)
    return Unprojection(unit_directions(x * scale, y * scale, cosine), squared <= math.pi**2)


@register_camera
class AtanCamera(PlaneCamera):
    """A field-of-view (FOV, ATAN) camera, as calibrated by PTAM, DSO, Tango and COLMAP; see ``project_atan``.

    Examples:
        >>> camera = AtanCamera([255.0, 255.0], [319.5, 239.5], 0.93, (480, 640))
        >>> camera.unproject(camera.project(torch.tensor([0.0, 0.6, 0.8])).pixels).directions
        tensor([0.0000, 0.6000, 0.8000])
    """

    model = "atan"
    functions = project_atan, unproject_atan

    omega: Intrinsic = Intrinsic(above=0, below=math.pi, unit="radians")
    image_size: ImageSize = ImageSize()
    max_angle: MaxAngle = MaxAngle(default=None)


fitted(AtanCamera, shape_grid((0.05, 0.3, 0.6, 0.9, 1.2, 1.6, 2.2)), bounds={"omega": (1e-3, 3.1)})
