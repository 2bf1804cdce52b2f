# SPDX-License-Identifier: Apache-2.0
"""The equirectangular panorama as a camera."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from sphericalvision.cameras.base import Camera, Projection, Unprojection
from sphericalvision.cameras.precision import model_function
from sphericalvision.cameras.registry import register_camera
from sphericalvision.core import ArgumentError
from sphericalvision.geometry import (
    bilinear_sample,
    directions_from_longitude_latitude,
    longitude_latitude_from_directions,
)
from sphericalvision.geometry.directions import components, from_components

__all__ = ["EquirectangularCamera", "project_equirectangular", "unproject_equirectangular"]


@model_function
def project_equirectangular(
    points: Float[Tensor, "*#batch 3"], image_size: Sequence[int], vertical_field_of_view: float = math.pi
) -> Projection:
    """Pixels (*, 2) of ``points`` (*, 3) on a panorama of ``image_size`` (height, width).

    Forward (+z) is the middle column, the right (+x) three quarters across, up (−y) the top row. Pixel centre i of
    width W has longitude (i + 0.5)·2π/W − π.

    Examples:
        >>> project_equirectangular(torch.tensor([0.0, 0.0, 1.0]), (100, 200)).pixels.tolist()
        [99.5, 49.5]
    """
    height, width = image_size
    longitude, latitude = longitude_latitude_from_directions(points)
    u = (longitude + math.pi) * (width / (2 * math.pi)) - 0.5
    v = (vertical_field_of_view / 2 - latitude) * (height / vertical_field_of_view) - 0.5
    x, y, z = points.unbind(-1)
    return Projection(from_components(u, v), x.abs() + y.abs() + z.abs() > 0)


@model_function
def unproject_equirectangular(
    pixels: Float[Tensor, "*#batch 2"], image_size: Sequence[int], vertical_field_of_view: float = math.pi
) -> Unprojection:
    """Unit directions (*, 3) of ``pixels`` (*, 2): the inverse of ``project_equirectangular``.

    Examples:
        >>> up = unproject_equirectangular(torch.tensor([99.5, -0.5]), (100, 200)).directions
        >>> up[1].item()
        -1.0
    """
    height, width = image_size
    u, v = components(pixels)
    longitude = (u + 0.5) * (2 * math.pi / width) - math.pi
    latitude = vertical_field_of_view / 2 - (v + 0.5) * (vertical_field_of_view / height)
    directions = directions_from_longitude_latitude(longitude, latitude)
    return Unprojection(directions, latitude.abs() <= math.pi / 2 + 8 * torch.finfo(pixels.dtype).eps)


@register_camera
class EquirectangularCamera(Camera):
    """An equirectangular panorama; it sees everything, and its left and right edges meet.

    Args:
        image_size: (height, width).
        vertical_field_of_view: in radians, centred on the horizon; less than π leaves out the poles.

    Examples:
        >>> camera = EquirectangularCamera((160, 320))
        >>> camera.project(torch.tensor([1.0, 0.0, 0.0])).pixels.round().tolist()  # to the right
        [240.0, 80.0]
    """

    model = "equirectangular"
    option_names: ClassVar[tuple[str, ...]] = ("vertical_field_of_view",)

    def __init__(self, image_size: Sequence[int], vertical_field_of_view: float = math.pi) -> None:
        if not 0 < vertical_field_of_view <= math.pi + 1e-9:
            raise ArgumentError(
                f"vertical_field_of_view: expected radians in (0, π], got {vertical_field_of_view}"
            )
        super().__init__(image_size, math.pi)
        self.vertical_field_of_view = float(vertical_field_of_view)

    def contains(self, pixels: Float[Tensor, "*pixels 2"]) -> Bool[Tensor, " ..."]:
        """As for any camera, up to rounding at the seam, where the outermost half pixels meet."""
        height, width = self.image_size
        slack = 8 * torch.finfo(pixels.dtype).eps * max(height, width)
        u, v = pixels.unbind(-1)
        inside_u = (u >= -0.5 - slack) & (u <= width - 0.5 + slack)
        return inside_u & (v >= -0.5 - slack) & (v <= height - 0.5 + slack)

    def _on_pixels(
        self, scale: tuple[float, float], offset: tuple[float, float], image_size: tuple[int, int]
    ) -> EquirectangularCamera:
        """A panorama stays one if it keeps all columns and as many rows above the horizon as below."""
        height, width = round(image_size[0] / scale[1]), round(image_size[1] / scale[0])
        above = round(scale[1] / 2 - 0.5 - offset[1])
        below = self.image_size[0] - height - above
        if width != self.image_size[1] or above != below:
            raise ArgumentError(
                f"cropped: a part of a panorama is a panorama only if it keeps all {self.image_size[1]} columns and "
                f"leaves out as many rows at the top as at the bottom, got {width} columns, {above} rows less at the "
                f"top and {below} at the bottom; reproject it to another camera instead"
            )
        changed = copy.copy(self)
        changed.image_size = image_size
        changed.vertical_field_of_view = self.vertical_field_of_view * height / self.image_size[0]
        return changed

    def _within_max_angle(self, points: Tensor) -> Tensor:
        """As for any camera, and straight back."""
        return super()._within_max_angle(points) | (self._widest(points) > math.pi)

    def _project(self, points: Tensor) -> Projection:
        return project_equirectangular(points, self.image_size, self.vertical_field_of_view)

    def _unproject(self, pixels: Tensor) -> Unprojection:
        return unproject_equirectangular(pixels, self.image_size, self.vertical_field_of_view)

    def interpolate(
        self, image: Shaped[Tensor, "*images c h w"], pixels: Float[Tensor, "*pixels n 2"]
    ) -> Float[Tensor, "*batch c n"]:
        """As for any camera, across the seam."""
        if (
            self.vertical_field_of_view < math.pi - 1e-9
        ):  # what lies beyond the outermost rows is not in the image
            u, v = pixels.unbind(-1)
            pixels = torch.stack((u, v.clamp(0, self.image_size[0] - 1)), -1)
        return bilinear_sample(image, pixels, wrap_longitude=True)
