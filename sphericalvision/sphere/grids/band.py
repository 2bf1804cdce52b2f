# SPDX-License-Identifier: Apache-2.0
"""A panorama of all longitudes and of the latitudes near the horizon."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.geometry import (
    bilinear_sample,
    directions_from_longitude_latitude,
    longitude_latitude_from_directions,
)
from sphericalvision.sphere.grids.equirectangular import wrap_panorama
from sphericalvision.sphere.grids.values import check_positive

__all__ = ["EquirectangularBand"]


class EquirectangularBand(nn.Module):
    """The rows of a panorama of square pixels that are nearest to the horizon, or all of them.

    Convention:
        That of ``Equirectangular``, which it is for width = 2 · height: forward (+z) is the middle, longitude grows to
        the right. The upper edge has latitude ``max_latitude`` = π · H / W, and pixel centre j the latitude
        max_latitude · (1 - (2j + 1) / H).

    Args:
        height: number of rows, at most half of the width.
        width: number of columns, over 360° of longitude.
        dtype: of the directions; the default dtype of torch when not given.

    Raises:
        ArgumentError: if a size is not a positive integer, or there are rows beyond the poles.

    Examples:
        >>> band = EquirectangularBand(160, 640)
        >>> band
        EquirectangularBand(height=160, width=640, latitudes within 45.0°)
        >>> round(band.solid_angles.sum().item() / (4 * math.pi), 3)  # of the sphere
        0.707
    """

    directions: Tensor

    def __init__(
        self,
        height: int,
        width: int,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        check_positive(height=height, width=width)
        if 2 * height > width:
            raise ArgumentError(
                f"height, width: expected a height of at most half the width (pixels are square, and columns go "
                f"once around), got {height} and {width}"
            )
        self.height, self.width = height, width
        column = torch.arange(width, dtype=torch.float64)
        row = torch.arange(height, dtype=torch.float64)
        longitude = (2 * column + 1 - width) * (math.pi / width)
        latitude = (height - 1 - 2 * row) * (math.pi / width)
        directions = directions_from_longitude_latitude(longitude, latitude[:, None])
        self.register_buffer(
            "directions", directions.to(dtype or torch.get_default_dtype()), persistent=False
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of values on this grid, ``(height, width)``."""
        return (self.height, self.width)

    @property
    def max_latitude(self) -> float:
        """Latitude of the upper edge in radians."""
        return math.pi * self.height / self.width

    @property
    def whole_sphere(self) -> bool:
        """Whether the panorama reaches up to the poles."""
        return 2 * self.height == self.width

    @property
    def solid_angles(self) -> Tensor:
        """Exact solid angle of each pixel ``(height, width)`` in steradians."""
        top = self.max_latitude
        edges = torch.linspace(top, -top, self.height + 1, dtype=torch.float64)
        rows = (edges[:-1].sin() - edges[1:].sin()) * (2 * math.pi / self.width)
        return rows.to(self.directions)[:, None].expand(self.shape)

    def pixels(self, directions: Tensor) -> Tensor:
        """Return the pixel coordinates (u, v) ``(*, 2)`` of directions ``(*, 3)``; integers are pixel centres."""
        longitude, latitude = longitude_latitude_from_directions(directions)
        u = longitude * (self.width / (2 * math.pi)) + (self.width - 1) / 2
        v = (self.height - 1) / 2 - latitude * (self.width / (2 * math.pi))
        return torch.stack((u, v), -1)

    def contains(self, directions: Tensor) -> Tensor:
        """Whether directions ``(*, 3)`` are within the band, its edges included ``(*)``."""
        if self.whole_sphere:
            return torch.ones_like(directions[..., 0], dtype=torch.bool)
        return longitude_latitude_from_directions(directions)[1].abs() <= self.max_latitude + 1e-6

    def sample(self, values: Tensor, directions: Tensor) -> Tensor:
        """Interpolate values ``(*b, height, width)`` linearly at directions ``(V, 3)``: ``(*b, V)``.

        Continues across the left and right edges and over the poles; beyond the latitudes of a band its outermost
        rows are repeated, see ``contains``.

        Examples:
            >>> band = EquirectangularBand(4, 8)
            >>> band.sample(torch.arange(4.0)[:, None].expand(4, 8), torch.tensor([[0.0, 0.0, 1.0]]))
            tensor([1.5000])
        """
        if tuple(values.shape[-2:]) != self.shape:
            raise ShapeError(
                f"values: expected shape (*, {self.height}, {self.width}), got {tuple(values.shape)}"
            )
        batch = values.shape[:-2]
        image = wrap_panorama(values, poles=self.whole_sphere).reshape(1, -1, self.height + 2, self.width + 2)
        pixels = self.pixels(directions.to(values.device)).reshape(1, -1, 2).to(values.dtype) + 1
        return bilinear_sample(image, pixels).reshape(*batch, *directions.shape[:-1])

    def rows_of(self, panorama: Tensor) -> Tensor:
        """Return this band's rows ``(*, height, width)`` of a panorama of the band or of the whole sphere.

        Raises:
            ShapeError: if the panorama's pixels are not those of the band.

        Examples:
            >>> EquirectangularBand(2, 8).rows_of(torch.arange(4)[:, None].expand(4, 8))[:, 0]
            tensor([1, 2])
        """
        height, width = panorama.shape[-2:]
        first, odd = divmod(height - self.height, 2)
        if width != self.width or (height != self.height and 2 * height != width) or odd:
            larger = (
                "" if self.whole_sphere else f" or ({self.width // 2}, {self.width}) for the whole sphere"
            )
            raise ShapeError(
                f"panorama: expected height and width {self.shape}{larger}, got {(height, width)}"
            )
        return panorama[..., first : first + self.height, :]

    def extra_repr(self) -> str:
        degrees = math.degrees(self.max_latitude)
        return f"height={self.height}, width={self.width}, latitudes within {degrees:.1f}°"
