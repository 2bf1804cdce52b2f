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
from sphericalvision.cameras.checks import model_function
from sphericalvision.cameras.registry import register_camera
from sphericalvision.core import ArgumentError
from sphericalvision.geometry import (
    bilinear_sample,
    directions_from_longitude_latitude,
    longitude_latitude_from_directions,
)
from sphericalvision.geometry.directions import components, from_components
from sphericalvision.geometry.panorama import (
    ALL_LATITUDES,
    ALL_LONGITUDES,
    checked_limits,
    goes_around,
    limits_in_words,
    longitude_within,
)


@model_function
def project_equirectangular(
    points: Float[Tensor, "*#batch 3"],
    image_size: Sequence[int],
    vertical_field_of_view: float = math.pi,
    latitudes: tuple[float, float] | None = None,
    longitudes: tuple[float, float] = ALL_LONGITUDES,
) -> Projection:
    """Pixels (*, 2) of ``points`` (*, 3) on a panorama of ``image_size`` (height, width).

    Forward (+z) is the middle column, the right (+x) three quarters across, up (−y) the top row. Pixel centre i of
    width W has longitude (i + 0.5)·2π/W − π; with limits, see ``EquirectangularCamera``, left + (i + 0.5)·(right −
    left)/W.

    Examples:
        >>> project_equirectangular(torch.tensor([0.0, 0.0, 1.0]), (100, 200)).pixels.tolist()
        [99.5, 49.5]
    """
    height, width = image_size
    bottom, top = latitudes or (-vertical_field_of_view / 2, vertical_field_of_view / 2)
    left, right = longitudes
    longitude, latitude = longitude_latitude_from_directions(points)
    u = (longitude_within(longitude, longitudes) - left) * (width / (right - left)) - 0.5
    v = (top - latitude) * (height / (top - bottom)) - 0.5
    x, y, z = points.unbind(-1)
    return Projection(from_components(u, v), x.abs() + y.abs() + z.abs() > 0)


@model_function
def unproject_equirectangular(
    pixels: Float[Tensor, "*#batch 2"],
    image_size: Sequence[int],
    vertical_field_of_view: float = math.pi,
    latitudes: tuple[float, float] | None = None,
    longitudes: tuple[float, float] = ALL_LONGITUDES,
) -> Unprojection:
    """Unit directions (*, 3) of ``pixels`` (*, 2): the inverse of ``project_equirectangular``.

    Examples:
        >>> up = unproject_equirectangular(torch.tensor([99.5, -0.5]), (100, 200)).directions
        >>> up[1].item()
        -1.0
    """
    height, width = image_size
    bottom, top = latitudes or (-vertical_field_of_view / 2, vertical_field_of_view / 2)
    left, right = longitudes
    u, v = components(pixels)
    longitude = (u + 0.5) * ((right - left) / width) + left
    latitude = top - (v + 0.5) * ((top - bottom) / height)
    directions = directions_from_longitude_latitude(longitude, latitude)
    return Unprojection(directions, latitude.abs() <= math.pi / 2 + 8 * torch.finfo(pixels.dtype).eps)


@register_camera
class EquirectangularCamera(Camera):
    """An equirectangular panorama, of the whole sphere or between limits of latitude and longitude.

    Left and right edges meet where it goes all the way around.

    Args:
        image_size: (height, width).
        vertical_field_of_view: in radians, centred on the horizon; less than π leaves out the poles.
        latitudes: (lower, upper) of the image's edges in radians, in place of ``vertical_field_of_view``.
        longitudes: (left, right) of the edges in radians, at most 2π apart; right of π is behind, from the left.

    Raises:
        ArgumentError: limits beyond a pole, of more than a turn, or in the wrong order.

    Examples:
        >>> camera = EquirectangularCamera((160, 320))
        >>> camera.project(torch.tensor([1.0, 0.0, 0.0])).pixels.round().tolist()  # to the right
        [240.0, 80.0]
        >>> EquirectangularCamera((80, 80), latitudes=(0, math.pi / 2), longitudes=(-math.pi / 2, 0))
        EquirectangularCamera(image_size=(80, 80), latitudes 0.0° to 90.0°, longitudes -90.0° to 0.0°)
    """

    model = "equirectangular"
    option_names: ClassVar[tuple[str, ...]] = ("vertical_field_of_view", "latitudes", "longitudes")
    default_names: ClassVar[tuple[str, ...]] = ("latitudes", "longitudes")

    def __init__(
        self,
        image_size: Sequence[int],
        vertical_field_of_view: float | None = None,
        latitudes: Sequence[float] | None = None,
        longitudes: Sequence[float] = ALL_LONGITUDES,
    ) -> None:
        if vertical_field_of_view is not None and not 0 < vertical_field_of_view <= math.pi + 1e-9:
            raise ArgumentError(
                f"vertical_field_of_view: expected radians in (0, π], got {vertical_field_of_view}"
            )
        super().__init__(image_size, math.pi)
        half = (math.pi if vertical_field_of_view is None else vertical_field_of_view) / 2
        self.latitudes, self.longitudes = checked_limits(latitudes or (-half, half), longitudes)
        if vertical_field_of_view is not None and abs(self.vertical_field_of_view - 2 * half) > 1e-6:
            raise ArgumentError(
                f"vertical_field_of_view, latitudes: expected one of them, or an equal span, got {2 * half:g} and "
                f"{self.vertical_field_of_view:g}"
            )

    @property
    def vertical_field_of_view(self) -> float:
        """From the lower to the upper edge, in radians."""
        return self.latitudes[1] - self.latitudes[0]

    @property
    def edges(self) -> str:
        """How images go on beyond their edges: ``"sphere"``, ``"around"`` without the poles, else ``"border"``."""
        if not goes_around(self.longitudes):
            return "border"
        return "sphere" if self.latitudes == ALL_LATITUDES else "around"

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
        """The panorama whose pixels are ``scale * pixels + offset``: other limits."""
        (bottom, top), (left, right) = self.latitudes, self.longitudes
        edges = []
        for low, high, s, shift, old, new in (
            (left, right, scale[0], offset[0], self.image_size[1], image_size[1]),
            (top, bottom, scale[1], offset[1], self.image_size[0], image_size[0]),
        ):
            first = 0.5 - (0.5 + shift) / s  # the new edge, in old pixels from the old one
            edges += [low + place / old * (high - low) for place in (first, first + new / s)]
        changed = copy.copy(self)
        changed.image_size = image_size
        changed.latitudes, changed.longitudes = checked_limits((edges[3], edges[2]), edges[:2])
        return changed

    def _within_max_angle(self, points: Tensor) -> Tensor:
        """As for any camera, and straight back."""
        return super()._within_max_angle(points) | (self._widest(points) > math.pi)

    def _project(self, points: Tensor) -> Projection:
        return project_equirectangular(
            points, self.image_size, latitudes=self.latitudes, longitudes=self.longitudes
        )

    def _unproject(self, pixels: Tensor) -> Unprojection:
        return unproject_equirectangular(
            pixels, self.image_size, latitudes=self.latitudes, longitudes=self.longitudes
        )

    def interpolate(
        self, image: Shaped[Tensor, "*images c h w"], pixels: Float[Tensor, "*pixels n 2"]
    ) -> Float[Tensor, "*batch c n"]:
        """As for any camera, across the seam."""
        edges = self.edges
        if edges != "sphere":  # what lies beyond the outermost rows is not in the image
            u, v = pixels.unbind(-1)
            pixels = torch.stack((u, v.clamp(0, self.image_size[0] - 1)), -1)
        return bilinear_sample(image, pixels, wrap_longitude=edges != "border")

    def __repr__(self) -> str:
        limits = limits_in_words(self.latitudes, self.longitudes)
        return f"EquirectangularCamera(image_size={self.image_size}{limits})"
