# SPDX-License-Identifier: Apache-2.0
"""The equirectangular grid: rows of equal latitude, columns of equal longitude, over all of the sphere or a part."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from sphericalvision.core import ArgumentError, ShapeError, check_counts, check_floating, check_last_dim
from sphericalvision.geometry import (
    bilinear_sample,
    directions_from_longitude_latitude,
    longitude_latitude_from_directions,
)
from sphericalvision.geometry.bilinear import wrap_panorama
from sphericalvision.geometry.directions import check_directions, from_components
from sphericalvision.geometry.panorama import (
    ALL_LATITUDES,
    ALL_LONGITUDES,
    checked_limits,
    goes_around,
    limits_in_words,
    longitude_within,
)
from sphericalvision.sphere.grids.sphere_grid import GridModule, check_cells, check_values


class Equirectangular(GridModule):
    """A panorama of ``height`` rows and ``width`` columns as a grid of directions.

    Convention:
        Forward (+z) is the middle of the picture, longitude grows to the right (+x), latitude is ``max_latitude``
        at the upper edge of the top row: +π/2 (up, -y), or less for a panorama without the poles. Pixel centre i of
        width W has longitude (i + 0.5)·2π/W - π, and row j of height H latitude L - (j + 0.5)·2L/H with
        L = ``max_latitude``. With other limits a row is (upper - lower)/H high and a column (right - left)/W wide.
        Interpolation continues across the left and right edges where these meet, and over the poles if there are both;
        beyond other limits the outermost rows and columns are repeated, see ``contains``.

    Args:
        height: number of rows, from the highest latitude to the lowest.
        width: number of columns, over 360° or between the limits of ``longitudes``.
        dtype: of the directions; the default dtype of torch when not given.
        device: of all tables.
        max_latitude: in radians, of the upper edge, and of the lower one below the horizon; π/2 if not given.
        latitudes: (lower, upper) edge in radians, in place of ``max_latitude``.
        longitudes: (left, right) edge in radians, at most 2π apart; right of π is behind, from the left.

    Raises:
        ArgumentError: if a size is not a positive integer or too large, the latitude is not in (0, π/2], or limits are
            beyond a pole, of more than a turn, or in the wrong order.

    Examples:
        >>> grid = Equirectangular(3, 5)
        >>> grid
        Equirectangular(height=3, width=5)
        >>> grid.directions[1, 2]  # the middle of the picture looks forward
        tensor([0., -0., 1.])
        >>> horizon = Equirectangular(160, 640, max_latitude=math.pi / 4)
        >>> round(horizon.solid_angles.sum().item() / (4 * math.pi), 3)  # of the sphere
        0.707
        >>> Equirectangular(80, 80, latitudes=(0, math.pi / 2), longitudes=(0, math.pi / 2))
        Equirectangular(height=80, width=80, latitudes 0.0° to 90.0°, longitudes 0.0° to 90.0°)
    """

    def __init__(
        self,
        height: int,
        width: int,
        dtype: torch.dtype | None = None,
        device: torch.device | str | None = None,
        max_latitude: float = math.pi / 2,
        latitudes: Sequence[float] | None = None,
        longitudes: Sequence[float] = ALL_LONGITUDES,
    ) -> None:
        super().__init__()
        check_counts(height=height, width=width)
        check_cells(height * width, height=height, width=width)
        if not 0 < max_latitude <= math.pi / 2 + 1e-9:
            raise ArgumentError(f"max_latitude: expected radians in (0, π/2], got {max_latitude!r}")
        self.height, self.width = height, width
        self.latitudes, self.longitudes = checked_limits(
            latitudes or (-max_latitude, max_latitude), longitudes
        )
        self._make_directions(dtype, device)

    @classmethod
    def with_square_pixels(
        cls,
        height: int,
        width: int,
        dtype: torch.dtype | None = None,
        device: torch.device | str | None = None,
    ) -> Equirectangular:
        """The rows nearest to the horizon whose pixels are as high as wide: ``max_latitude`` is π · height / width.

        Raises:
            ArgumentError: if there are rows beyond the poles.

        Examples:
            >>> Equirectangular.with_square_pixels(160, 640)
            Equirectangular(height=160, width=640, latitudes within 45.0°)
        """
        check_counts(height=height, width=width)
        if 2 * height > width:
            raise ArgumentError(
                f"height, width: expected a height of at most half the width (pixels are square, and columns go "
                f"once around), got {height} and {width}"
            )
        return cls(height, width, dtype, device, math.pi * height / width)

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of values on this grid, ``(height, width)``."""
        return (self.height, self.width)

    @property
    def whole_sphere(self) -> bool:
        """Whether the panorama goes all the way around and reaches up to the poles."""
        return self.image_edges == "sphere"

    @property
    def max_latitude(self) -> float:
        """The latitude that is farthest from the horizon, in radians, above or below."""
        return max(map(abs, self.latitudes))

    @property
    def _pixel(self) -> tuple[float, float]:
        """(height, width) of a pixel in radians, along its meridian and along the equator."""
        (bottom, top), (left, right) = self.latitudes, self.longitudes
        return (top - bottom) / self.height, (right - left) / self.width

    @property
    def solid_angles(self) -> Float[Tensor, "h w"]:
        """Exact solid angle of each pixel ``(height, width)`` in steradians."""
        bottom, top = self.latitudes
        edges = torch.linspace(top, bottom, self.height + 1, dtype=torch.float64)
        rows = (edges[:-1].sin() - edges[1:].sin()) * self._pixel[1]
        return rows.to(self.directions)[:, None].expand(self.shape)

    @property
    def cell_widths(self) -> Float[Tensor, "h w"]:
        """Width ``(height, width)`` in radians at the equator: near the poles a row has more pixels than content."""
        return self.directions.new_full(self.shape, math.sqrt(math.prod(self._pixel)))

    def cell_samples(
        self, samples: int, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> tuple[Float[Tensor, "P k 3"], Float[Tensor, "#P k"]]:
        """Directions ``(height * width, samples**2, 3)`` spread over each pixel, and shares of its solid angle."""
        height, width = self.height * samples, self.width * samples
        column = torch.arange(width, dtype=torch.float64, device=device)
        row = torch.arange(height, dtype=torch.float64, device=device)
        (bottom, top), (left, right) = self.latitudes, self.longitudes
        # (2i + 1 - W) / W keeps the middle column of an odd width at longitude zero to the last bit.
        longitude = (2 * column + 1 - width) * ((right - left) / 2 / width) + (left + right) / 2
        latitude = (height - 1 - 2 * row) * ((top - bottom) / 2 / height) + (bottom + top) / 2
        directions = directions_from_longitude_latitude(longitude, latitude[:, None])
        directions = directions.view(self.height, samples, self.width, samples, 3).transpose(1, 2)
        weights = latitude.cos().view(-1, samples).repeat_interleave(samples, 1)  # of a row's cells
        weights = (weights / weights.sum(-1, keepdim=True)).repeat_interleave(self.width, 0)
        dtype = dtype or self.directions.dtype
        return directions.reshape(-1, samples**2, 3).to(dtype), weights.to(dtype)

    def pixels(self, directions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
        """Return the pixel coordinates (u, v) ``(*, 2)`` of directions ``(*, 3)``; integers are pixel centres.

        Examples:
            >>> Equirectangular(2, 4).pixels(torch.tensor([0.0, 0.0, 1.0]))
            tensor([1.5000, 0.5000])
        """
        longitude, latitude = longitude_latitude_from_directions(directions)
        (bottom, top), (left, right) = self.latitudes, self.longitudes
        east = longitude_within(longitude, self.longitudes) - (left + right) / 2
        u = east * (self.width / (right - left)) + (self.width - 1) / 2
        v = (self.height - 1) / 2 - (latitude - (bottom + top) / 2) * (self.height / (top - bottom))
        return from_components(u, v)

    def contains(self, directions: Float[Tensor, "*batch 3"]) -> Bool[Tensor, "*batch"]:
        """Whether directions ``(*, 3)`` are within the panorama's limits, its edges included ``(*)``.

        Examples:
            >>> up_and_forward = torch.tensor([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
            >>> Equirectangular.with_square_pixels(4, 16).contains(up_and_forward)
            tensor([False,  True])
        """
        check_last_dim("directions", directions, 3)
        if self.whole_sphere:
            return directions.isfinite().all(-1)
        slack = 4 * torch.finfo(directions.dtype).eps
        longitude, latitude = longitude_latitude_from_directions(directions.double())
        (bottom, top), (left, right) = self.latitudes, self.longitudes
        inside = (latitude >= bottom - slack) & (latitude <= top + slack)
        if not goes_around(self.longitudes):
            east = longitude_within(longitude, self.longitudes)
            inside = inside & (east >= left - slack) & (east <= right + slack)
        return inside

    def nearest(self, directions: Float[Tensor, "*batch 3"]) -> Int[Tensor, "*batch"]:
        """Return the index ``(*)``, ``row * width + column``, of the pixel that contains each direction ``(*, 3)``.

        A direction midway between two columns or rows, as whole meridians of an icosphere are, goes to the even one.

        Examples:
            >>> Equirectangular(3, 5).nearest(torch.tensor([0.0, 0.0, 1.0]))
            tensor(7)
        """
        check_directions(directions)
        # Single precision makes ties of what differs from one by rounding only.
        column, row = self.pixels(directions.detach().double()).float().round().long().unbind(-1)
        return row.clamp(0, self.height - 1) * self.width + column.clamp(0, self.width - 1)

    def rows_of(self, panorama: Shaped[Tensor, "*batch h w"]) -> Shaped[Tensor, "*batch rows w"]:
        """Return this grid's rows ``(*, height, width)`` of a panorama of its size or of the whole sphere.

        Raises:
            ShapeError: if the panorama's pixels are not those of this grid.

        Examples:
            >>> grid = Equirectangular.with_square_pixels(2, 8)
            >>> grid.rows_of(torch.arange(4)[:, None].expand(4, 8))[:, 0]
            tensor([1, 2])
        """
        whole = round(math.pi / self._pixel[0])
        if tuple(panorama.shape[-2:]) not in (self.shape, (whole, self.width)):
            larger = "" if self.whole_sphere else f" or {(whole, self.width)} for the whole sphere"
            raise ShapeError(
                f"panorama: expected height and width {self.shape}{larger}, got {tuple(panorama.shape[-2:])}"
            )
        own = panorama.shape[-2] == self.height
        first = 0 if own else round((math.pi / 2 - self.latitudes[1]) / self._pixel[0])
        return panorama[..., first : first + self.height, :]

    @property
    def image_edges(self) -> str:
        """How ``image`` continues beyond its edges: ``"sphere"``, ``"around"`` without the poles, or ``"border"``."""
        if not goes_around(self.longitudes):
            return "border"
        return "sphere" if self.latitudes == ALL_LATITUDES else "around"

    def image(self, values: Float[Tensor, "*batch c h w"]) -> Float[Tensor, "*batch c h w"]:
        """The panorama ``(*b, c, height, width)`` itself, in which ``image_pixels`` are meant."""
        check_values(values, self.shape)
        return values

    def image_pixels(self, directions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
        """Pixels (u, v) ``(*, 2)`` of ``image`` at which bilinear interpolation gives the value of each direction.

        Differentiable in the directions ``(*, 3)``.
        """
        check_floating("directions", directions)
        u, v = self.pixels(directions).unbind(-1)
        if u.requires_grad:
            # At a pole the longitude turns without end, though the picture hardly does: its derivative is left out.
            x, y, z = directions.detach().unbind(-1)
            u = torch.where(torch.hypot(x, z) < (1e-3 * self._pixel[0]) * y.abs(), u.detach(), u)
        if goes_around(self.longitudes):
            u = torch.where(u > self.width - 0.5, u - self.width, u)
        return from_components(u, v)

    def _interpolated(self, values: Tensor, directions: Tensor) -> Tensor:
        if not goes_around(self.longitudes):
            return super()._interpolated(values, directions)
        image = wrap_panorama(values, poles=self.whole_sphere)
        return bilinear_sample(image, self.image_pixels(directions) + 1)

    def extra_repr(self) -> str:
        return f"height={self.height}, width={self.width}{limits_in_words(self.latitudes, self.longitudes)}"
