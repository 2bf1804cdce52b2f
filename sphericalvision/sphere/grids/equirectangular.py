# SPDX-License-Identifier: Apache-2.0
"""The equirectangular grid: rows of equal latitude, columns of equal longitude."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from sphericalvision.core import check_last_dim
from sphericalvision.geometry import (
    bilinear_sample,
    directions_from_longitude_latitude,
    longitude_latitude_from_directions,
)
from sphericalvision.sphere.grids.values import check_positive, check_values

__all__ = ["Equirectangular", "wrap_panorama"]


def wrap_panorama(image: Tensor, poles: bool = True) -> Tensor:
    """A panorama ``(*, h, w)`` with one more column on either side and one more row above and below.

    Args:
        image: equirectangular, all around.
        poles: whether it reaches up to the poles; then beyond a pole stands its row as seen from behind, else the
            row is repeated.

    Examples:
        >>> wrap_panorama(torch.tensor([[1, 2, 3, 4]]).float())[0]
        tensor([2., 3., 4., 1., 2., 3.])
    """
    width = image.shape[-1]

    def beyond(row: Tensor) -> Tensor:  # an odd width has no pixel exactly behind, hence the mean of its two
        return (row.roll(width // 2, -1) + row.roll((width + 1) // 2, -1)) / 2 if poles else row

    image = torch.cat((beyond(image[..., :1, :]), image, beyond(image[..., -1:, :])), -2)
    return torch.cat((image[..., -1:], image, image[..., :1]), -1)


class Equirectangular(nn.Module):
    """A full panorama of ``height`` rows and ``width`` columns as a grid of directions.

    Convention:
        Forward (+z) is the middle of the picture, longitude grows to the right (+x), latitude is +π/2 (up,
        -y) above the top row. Pixel centre i of width W has longitude (i + 0.5)·2π/W - π, and row j of
        height H latitude π/2 - (j + 0.5)·π/H. Interpolation continues across the left and right edges and
        over the poles.

    Args:
        height: number of rows, over 180° of latitude.
        width: number of columns, over 360° of longitude.
        dtype: of the directions; the default dtype of torch when not given.
        device: of all tables.

    Raises:
        ArgumentError: if a size is not a positive integer.

    Examples:
        >>> grid = Equirectangular(3, 5)
        >>> grid
        Equirectangular(height=3, width=5)
        >>> grid.directions[1, 2]  # the middle of the picture looks forward
        tensor([0., -0., 1.])
    """

    directions: Tensor

    def __init__(
        self,
        height: int,
        width: int,
        dtype: torch.dtype | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        check_positive(height=height, width=width)
        self.height = height
        self.width = width
        directions = self.cell_samples(1, torch.float64, device)[0].view(height, width, 3)
        self.register_buffer(
            "directions", directions.to(dtype or torch.get_default_dtype()), persistent=False
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of values on this grid, ``(height, width)``."""
        return (self.height, self.width)

    @property
    def solid_angles(self) -> Tensor:
        """Exact solid angle of each pixel ``(height, width)`` in steradians."""
        edges = torch.linspace(math.pi / 2, -math.pi / 2, self.height + 1, dtype=torch.float64)
        rows = (edges[:-1].sin() - edges[1:].sin()) * (2 * math.pi / self.width)
        return rows.to(self.directions)[:, None].expand(self.shape)

    @property
    def cell_widths(self) -> Tensor:
        """Width ``(height, width)`` in radians at the equator: near the poles a row has more pixels than content."""
        width = math.sqrt(2 * math.pi / self.width * math.pi / self.height)
        return self.directions.new_full(self.shape, width)

    def cell_samples(
        self, samples: int, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> tuple[Tensor, Tensor]:
        """Directions ``(height * width, samples**2, 3)`` spread over each pixel, and shares of its solid angle."""
        height, width = self.height * samples, self.width * samples
        column = torch.arange(width, dtype=torch.float64, device=device)
        row = torch.arange(height, dtype=torch.float64, device=device)
        # (2i + 1 - W) / W keeps the middle column of an odd width at longitude zero to the last bit.
        longitude = (2 * column + 1 - width) * (math.pi / width)
        latitude = (height - 1 - 2 * row) * (math.pi / 2 / height)
        directions = directions_from_longitude_latitude(longitude, latitude[:, None])
        directions = directions.view(self.height, samples, self.width, samples, 3).transpose(1, 2)
        shares = latitude.cos().view(-1, 1, samples, 1).expand(-1, self.width, -1, samples)
        shares = shares.reshape(-1, samples**2)
        dtype = dtype or self.directions.dtype
        return (
            directions.reshape(-1, samples**2, 3).to(dtype),
            (shares / shares.sum(-1, keepdim=True)).to(dtype),
        )

    def pixels(self, directions: Tensor) -> Tensor:
        """Return the pixel coordinates (u, v) ``(*, 2)`` of directions ``(*, 3)``; integers are pixel centres.

        Examples:
            >>> Equirectangular(2, 4).pixels(torch.tensor([0.0, 0.0, 1.0]))
            tensor([1.5000, 0.5000])
        """
        longitude, latitude = longitude_latitude_from_directions(directions)
        u = longitude * (self.width / (2 * math.pi)) + (self.width - 1) / 2
        v = (self.height - 1) / 2 - latitude * (self.height / math.pi)
        return torch.stack((u, v), -1)

    def nearest(self, directions: Tensor) -> Tensor:
        """Return the index ``(*)``, ``row * width + column``, of the pixel that contains each direction ``(*, 3)``.

        Examples:
            >>> Equirectangular(3, 5).nearest(torch.tensor([0.0, 0.0, 1.0]))
            tensor(7)
        """
        check_last_dim("directions", directions, 3)
        column, row = (self.pixels(directions) + 0.5).floor().long().unbind(-1)
        return row.clamp(0, self.height - 1) * self.width + column % self.width

    def image(self, values: Tensor) -> Tensor:
        """The panorama with a border ``(*b, c, height + 2, width + 2)``, in which ``image_pixels`` are meant."""
        check_values(values, self.shape)
        return wrap_panorama(values)

    def image_pixels(self, directions: Tensor) -> Tensor:
        """Pixels (u, v) ``(*, 2)`` of ``image`` at which bilinear interpolation gives the value of each direction.

        Differentiable in the directions ``(*, 3)``.
        """
        x, y, z = directions.unbind(-1)
        # At a pole the longitude turns without end, though the picture hardly does: there its derivative is left out.
        at_pole = torch.hypot(x, z).detach() < (1e-3 * math.pi / self.height) * y.detach().abs()
        x, z = (torch.where(at_pole, side.detach(), side) for side in (x, z))
        u = self.pixels(torch.stack((x, y, z), -1))[..., 0]
        v = self.pixels(directions)[..., 1]
        return torch.stack((torch.remainder(u + 0.5, self.width) + 0.5, v + 1), -1)

    def sample(self, values: Tensor, directions: Tensor) -> Tensor:
        """Interpolate values bilinearly in longitude and latitude, across the seam and over the poles.

        Args:
            values: ``(*b, c, height, width)``, floating point.
            directions: ``(*b, n, 3)``, or ``(n, 3)`` for all of the batch.

        Returns:
            ``(*b, c, n)``, differentiable in both arguments.

        Raises:
            ShapeError: if the values are not on this grid.
        """
        return bilinear_sample(self.image(values), self.image_pixels(directions))

    def extra_repr(self) -> str:
        return f"height={self.height}, width={self.width}"
