# SPDX-License-Identifier: Apache-2.0
"""Geometry of the icosphere: midpoints of an icosahedron's edges, projected onto the sphere at each level."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sphericalvision.core import ArgumentError
from sphericalvision.icosphere.topology import check_level
from sphericalvision.tables import constant_table, copied


def icosahedron_rectangles(
    dtype: torch.dtype | None = None, device: torch.device | str | None = None
) -> Float[Tensor, "5 3 2 3"]:
    """Return the vertices of the icosahedron as five charts of three rows and two columns, ``(5, 3, 2, 3)``.

    The north pole is (0, -1, 0) and the first vertex of the upper ring is on the side of +z.

    Examples:
        >>> icosahedron_rectangles()[0, 0, 0]
        tensor([ 0., -1.,  0.])
    """
    longitude = torch.arange(6, dtype=torch.float64) * (2 * math.pi / 5)
    height, radius = 1 / math.sqrt(5), 2 / math.sqrt(5)

    def ring(longitude: Tensor, y: float) -> Tensor:
        return torch.stack(
            (radius * longitude.sin(), torch.full_like(longitude, y), radius * longitude.cos()), -1
        )

    upper, lower = ring(longitude, -height), ring(longitude - math.pi / 5, height)
    north = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64).expand(5, 3)
    rows = ((north, upper[1:]), (upper[:-1], lower[1:]), (lower[:-1], -north))
    return torch.stack([torch.stack(row, 1) for row in rows], 1).to(
        dtype=dtype or torch.get_default_dtype(), device=device
    )


@copied
@constant_table
def icosphere_vertices(
    level: int, dtype: torch.dtype | None = None, device: torch.device | str | None = None
) -> Float[Tensor, "V 3"]:
    """Return the vertices ``(V, 3)`` on the unit sphere: north pole, five charts row by row, south pole.

    Positions are computed in float64 whatever the ``dtype`` asked for.

    Examples:
        >>> icosphere_vertices(2).shape
        torch.Size([162, 3])
    """
    check_level(level)
    if dtype is not None and not dtype.is_floating_point:
        raise ArgumentError(f"dtype: expected a floating point type, got {dtype}")
    grid = icosahedron_rectangles(torch.float64, device)
    for _ in range(level):
        charts, rows, columns, _ = grid.shape
        finer = grid.new_empty(charts, 2 * rows - 1, 2 * columns - 1, 3)
        finer[:, ::2, ::2] = grid
        finer[:, 1::2, ::2] = F.normalize(grid[:, :-1] + grid[:, 1:], dim=-1)
        finer[:, ::2, 1::2] = F.normalize(grid[:, :, :-1] + grid[:, :, 1:], dim=-1)
        finer[:, 1::2, 1::2] = F.normalize(grid[:, 1:, :-1] + grid[:, :-1, 1:], dim=-1)
        grid = finer
    vertices = torch.cat((grid[0, 0, :1], grid[:, 1:, :-1].reshape(-1, 3), grid[0, -1, -1:]))
    return vertices.to(dtype or torch.get_default_dtype())
