# SPDX-License-Identifier: Apache-2.0
"""The grid of stored ground truth: equirectangular, of the full sphere or of latitudes near the horizon.

Convention: longitude grows to the right, forward (+z) is the middle of the width, up (-y) is the top row.
    Pixel (row,
column) has longitude (column + 0.5) * 2 pi / W - pi and latitude limit - (row + 0.5) * 2 pi / W.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from sphericalvision.core import ShapeError, check_last_dim
from sphericalvision.geometry import directions_from_longitude_latitude, longitude_latitude_from_directions

__all__ = ["NearestPixels", "latitude_limit", "nearest_pixels", "panorama_directions"]


class NearestPixels(NamedTuple):
    """Row-major indices ``(*)`` of panorama pixels, and whether the direction lies in the panorama "
    "``(*)``."""

    ids: Tensor
    valid: Tensor


def latitude_limit(height: int, width: int) -> float:
    """Latitude in radians of the upper edge of a panorama: pi/2 for W = 2H, pi/4 for W = 4H (the urban sets).

    Raises:
        ShapeError: the panorama is neither; pixels must be square and columns go once around.

    Examples:
        >>> latitude_limit(160, 640) == math.pi / 4
        True
    """
    if height < 1 or width not in (2 * height, 4 * height):
        raise ShapeError(
            f"panorama: expected width = 2 x height (full sphere) or 4 x height (latitudes within "
            f"45 degrees), got height {height}, width {width}"
        )
    return math.pi * height / width


def panorama_directions(height: int, width: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """Unit directions ``(height, width, 3)`` of a panorama's pixel centres.

    Raises:
        ShapeError: see ``latitude_limit``.

    Examples:
        >>> down_left = panorama_directions(2, 4)[1, 0]
        >>> [round(x, 3) for x in down_left.tolist()]
        [-0.5, 0.707, -0.5]
    """
    step = 2 * math.pi / width
    top = latitude_limit(height, width)
    longitude = (torch.arange(width, dtype=torch.float64) + 0.5) * step - math.pi
    latitude = top - (torch.arange(height, dtype=torch.float64) + 0.5) * step
    return directions_from_longitude_latitude(longitude[None, :], latitude[:, None]).to(dtype)


def nearest_pixels(directions: Tensor, height: int, width: int) -> NearestPixels:
    """Find the panorama pixel nearest to each direction.

    The icosphere's meridians often lie midway between two columns. Such ties go to the even column, as in the
    ``cv2.remap`` that the published results were made with.

    Args:
        directions: ``(*, 3)``, of any length but zero.
        height: rows of the panorama.
        width: columns of the panorama.

    Raises:
        ShapeError: see ``latitude_limit``.

    Examples:
        >>> nearest_pixels(torch.tensor([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]), height=160, width=640)
        NearestPixels(ids=tensor([  320, 51520]), valid=tensor([False,  True]))
    """
    check_last_dim("directions", directions, 3)
    top = latitude_limit(height, width)
    longitude, latitude = longitude_latitude_from_directions(directions.to(torch.float64))
    per_radian = width / (2 * math.pi)
    # Single precision makes ties of what differs from one by rounding only.
    column = ((longitude + math.pi) * per_radian - 0.5).to(torch.float32).round().long()
    row = ((top - latitude) * per_radian - 0.5).to(torch.float32).round().long()
    ids = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
    return NearestPixels(ids, latitude.abs() <= top + 1e-9)
