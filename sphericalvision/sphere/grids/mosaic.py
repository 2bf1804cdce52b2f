# SPDX-License-Identifier: Apache-2.0
"""Many square images as tiles of one, so that one ``grid_sample`` reads them all.

The tiles stand in rows of about as many as there are rows: coordinates stay small, and float32 exact enough.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor
from torch.nn import functional as F

from sphericalvision.geometry.directions import from_components


def mosaic(tiles: Shaped[Tensor, "*batch n s s"]) -> Shaped[Tensor, "*batch _ _"]:
    """One image ``(*, rows * s, columns * s)`` of tiles ``(*, n, s, s)``, row by row; zeros where none is left.

    Examples:
        >>> import torch
        >>> mosaic(torch.arange(3.0).view(3, 1, 1))
        tensor([[0., 1.],
                [2., 0.]])
    """
    count, side = tiles.shape[-3], tiles.shape[-1]
    columns = _columns(count)
    rows = -(-count // columns)
    tiles = F.pad(tiles, (0, 0, 0, 0, 0, rows * columns - count))
    tiles = tiles.unflatten(-3, (rows, columns)).transpose(-3, -2)
    return tiles.reshape(*tiles.shape[:-4], rows * side, columns * side)


def mosaic_pixels(
    tile: Int[Tensor, "*batch"], pixels: Float[Tensor, "*batch 2"], count: int, side: int
) -> Float[Tensor, "*batch 2"]:
    """Pixels (u, v) ``(*, 2)`` of the mosaic from pixels of tiles ``(*)`` of ``count``, each ``side`` wide.

    Examples:
        >>> import torch
        >>> mosaic_pixels(torch.tensor(2), torch.tensor([0.5, 1.0]), 3, 4).tolist()
        [0.5, 5.0]
    """
    columns = _columns(count)
    corners = [(side * (index % columns), side * (index // columns)) for index in range(count)]
    return pixels + pixels.new_tensor(corners)[tile]


def tile_samples(
    side: Float[Tensor, "s samples"], frames: Float[Tensor, "n 3 3"], dtype: torch.dtype
) -> tuple[Float[Tensor, "P k 3"], Float[Tensor, "#P k"]]:
    """Directions ``(n * s * s, samples**2, 3)`` spread over the pixels of tiles that touch the sphere, and their shares
    of each pixel's solid angle.

    Args:
        side: places in each pixel of a row, in the plane z = 1, and in each of a column.
        frames: columns are the right, down and forward axes of each tile.
        dtype: of both results.
    """
    x, y = side[:, None], side[:, None, :, None]
    lengths = (x * x + y * y + 1).sqrt()  # of rows, columns, and rows and columns in a pixel
    rays = from_components(x / lengths, y / lengths, 1 / lengths).view(-1, 3) @ frames.mT
    solid = (lengths**-3).flatten(2).flatten(0, 1)  # a step in the plane is so much of solid angle
    shares = (solid / solid.sum(-1, keepdim=True)).repeat(len(frames), 1)
    return rays.view(-1, solid.shape[1], 3).to(dtype), shares.to(dtype)


def _columns(count: int) -> int:
    return math.ceil(math.sqrt(count))
