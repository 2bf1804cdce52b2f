# SPDX-License-Identifier: Apache-2.0
"""The pinhole camera without distortion."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.base import Projection, Unprojection
from sphericalvision.cameras.checks import model_function
from sphericalvision.cameras.declaration import ImageSize, MaxAngle, OptionalIntrinsic
from sphericalvision.cameras.fitting import PLANE_REACH, fitted, shape_grid
from sphericalvision.cameras.models.image_plane import PlaneCamera, pixels_from_plane, plane_from_pixels
from sphericalvision.cameras.registry import register_camera
from sphericalvision.core import ArgumentError, check_type
from sphericalvision.geometry.directions import components, unit_directions


@model_function
def project_pinhole(
    points: Float[Tensor, "*#batch 3"],
    focal_length: Float[Tensor, "*#batch #2"],
    principal_point: Float[Tensor, "*#batch 2"],
) -> Projection:
    """Pixels (*, 2) of ``points`` (*, 3): (x, y)/z times ``focal_length`` (*, 2) plus ``principal_point`` (*, 2).

    Valid in front of the camera only; points behind it are sent far out to their side.

    Examples:
        >>> project_pinhole(torch.tensor([1.0, 0.0, 2.0]), torch.tensor([100.0]), torch.tensor([320.0, 240.0])).pixels
        tensor([370., 240.])
    """
    x, y, z = components(points)
    # At least so much that what is behind lands far out, and its square and derivatives stay finite.
    shrink = z.clamp_min(torch.finfo(z.dtype).tiny ** 0.4).reciprocal()
    return Projection(pixels_from_plane(x * shrink, y * shrink, focal_length, principal_point), z > 0)


@model_function
def unproject_pinhole(
    pixels: Float[Tensor, "*#batch 2"],
    focal_length: Float[Tensor, "*#batch #2"],
    principal_point: Float[Tensor, "*#batch 2"],
) -> Unprojection:
    """Unit directions (*, 3) of ``pixels`` (*, 2): the inverse of ``project_pinhole``.

    Examples:
        >>> center = torch.tensor([320.0, 240.0])
        >>> unproject_pinhole(center, torch.tensor([100.0]), center).directions
        tensor([0., 0., 1.])
    """
    x, y = plane_from_pixels(pixels, focal_length, principal_point)
    return Unprojection(unit_directions(x, y, torch.ones_like(x)), torch.ones_like(x, dtype=torch.bool))


@register_camera
class PinholeCamera(PlaneCamera):
    """A pinhole camera; images must be undistorted before. The border of the image is the limit of its view by default.

    Examples:
        >>> camera = PinholeCamera([500.0, 500.0], [319.5, 239.5], (480, 640))
        >>> camera.project(torch.tensor([0.0, 0.0, 1.0])).pixels.tolist()
        [319.5, 239.5]
    """

    model = "pinhole"
    functions = project_pinhole, unproject_pinhole

    image_size: ImageSize = ImageSize()
    max_angle: MaxAngle = MaxAngle(default=None)
    skew: OptionalIntrinsic = OptionalIntrinsic(default=None)

    def _model_end(self) -> Tensor:
        return torch.full_like(self.max_angle, math.pi / 2)

    @classmethod
    def from_field_of_view(
        cls,
        image_size: Sequence[int],
        field_of_view: float | Sequence[float],
        dtype: torch.dtype | None = None,
    ) -> PinholeCamera:
        """The camera that sees ``field_of_view`` radians across the shorter side of the image, edge to edge.

        Two angles are the horizontal and the vertical one.

        Raises:
            ArgumentError: a field of view is not between 0 and π.

        Examples:
            >>> PinholeCamera.from_field_of_view((480, 640), math.pi / 2).focal_length.tolist()
            [240.0, 240.0]
            >>> PinholeCamera.from_field_of_view((480, 640), (math.pi / 2, math.pi / 3)).focal_length.round().tolist()
            [320.0, 416.0]
        """
        height, width = image_size
        if isinstance(field_of_view, tuple | list) and len(field_of_view) == 2:
            angles, sides = list(field_of_view), [width, height]
        else:
            angles, sides = [field_of_view] * 2, [min(height, width)] * 2
        focal_length = []
        for angle, side in zip(angles, sides, strict=True):
            check_type("field_of_view", angle, (int, float), "radians across the shorter side, or a pair")
            if not 0 < angle < math.pi:
                raise ArgumentError(
                    f"field_of_view: expected radians in (0, π) for a pinhole, got {field_of_view}"
                )
            focal_length.append(side / 2 / math.tan(angle / 2))
        center = torch.tensor([(width - 1) / 2, (height - 1) / 2], dtype=dtype)
        return cls(focal_length, center, image_size)


fitted(PinholeCamera, shape_grid(), reach=PLANE_REACH)
