# SPDX-License-Identifier: Apache-2.0
"""Cells of an octahedron: a grid over all directions whose numbers cost a few operations and no search.

A direction pierces the octahedron |x| + |y| + |z| = 1. Each half of it, above and below y = 0, unfolds onto a square
with the coordinates x + z and x - z, which is cut into ``resolution**2`` cells.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor


def cell_numbers(rays: Float[Tensor, "3 m"], resolution: int) -> Int[Tensor, " m"]:
    """Numbers ``(m,)``, int32, of the cells of rays ``(3, m)`` of any length, below ``2 * resolution**2``.

    A zero vector or one with a NaN gets the number of some cell.

    Examples:
        >>> cell_numbers(torch.tensor([[0.0, 0.0], [-1.0, 1.0], [0.0, 0.0]]), resolution=1)  # up, down
        tensor([1, 0], dtype=torch.int32)
    """
    x, y, z = rays
    scale = x.abs().add_(y.abs()).add_(z.abs()).reciprocal_().mul_(resolution / 2)
    row, column = (
        across.mul_(scale).add_(resolution / 2).int().clamp_(0, resolution - 1) for across in (x + z, x - z)
    )
    return (y < 0).int().mul_(resolution).add_(row).mul_(resolution).add_(column)


def cell_centers(resolution: int) -> Float[Tensor, "3 n"]:
    """Rays ``(3, 2 * resolution**2)`` through the middles of the cells, in the order of their numbers.

    Examples:
        >>> cell_numbers(cell_centers(8), 8).equal(torch.arange(128, dtype=torch.int32))
        True
    """
    centers = (torch.arange(resolution) + 0.5) * (2 / resolution) - 1
    x, z = (centers[:, None] + centers) / 2, (centers[:, None] - centers) / 2
    y = 1 - x.abs() - z.abs()
    return torch.stack([torch.stack(both).flatten() for both in ((x, x), (y, -y), (z, z))])
