# SPDX-License-Identifier: Apache-2.0
"""Solid angles of pixels of a tangent plane, cut by a triangle."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["solid_angles_in_triangle"]


def solid_angles_in_triangle(
    edges: Float[Tensor, " ..."], corners: Float[Tensor, " ..."]
) -> Float[Tensor, "t k k"]:
    """Solid angle ``(t, k, k)`` of the part of each pixel that lies inside a triangle, in steradians.

    The boundary of that part is the pixel's edges inside the triangle and the triangle's edges inside the pixel. Each
    piece spans a triangle with the point where the plane touches the sphere; their signed solid angles add up.

    Args:
        edges: ``(k + 1,)`` where the pixels of a row end in the plane z = 1, and those of a column.
        corners: ``(t, 3, 2)`` of the triangles, from x to y around.

    Examples:
        >>> whole = torch.tensor([[[-9.0, -9.0], [9.0, -9.0], [0.0, 9.0]]], dtype=torch.float64)
        >>> angle = solid_angles_in_triangle(torch.tensor([-1.0, 1.0], dtype=torch.float64), whole)
        >>> round((angle / torch.pi).item(), 6)  # a face of the cube is a sixth of 4π
        0.666667
    """
    low, high = edges[:-1], edges[1:]
    y_low, x_low = torch.meshgrid(low, low, indexing="ij")
    y_high, x_high = torch.meshgrid(high, high, indexing="ij")
    box = torch.stack((x_low, y_low, x_high, y_low, x_high, y_high, x_low, y_high), -1).unflatten(-1, (4, 2))

    start, end = corners, corners.roll(-1, 1)
    inward = torch.stack((start[..., 1] - end[..., 1], end[..., 0] - start[..., 0]), -1)
    # Distances inside of each line of a triangle (t, k, k, 4, 3) and of each side of a box (t, k, k, 3, 4).
    to_lines = ((box[..., None, :] - start[:, None, None, None]) * inward[:, None, None, None]).sum(-1)
    a = start[:, None, None].expand(-1, *x_low.shape, -1, -1)
    b = end[:, None, None].expand_as(a)

    def to_sides(point: Tensor) -> Tensor:
        x, y = point.unbind(-1)
        sides = (x - x_low[..., None], x_high[..., None] - x, y - y_low[..., None], y_high[..., None] - y)
        return torch.stack(sides, -1)

    pixel_edges = _swept(box.expand(len(corners), -1, -1, -1, -1), to_lines)
    return pixel_edges + _swept_between(a, b, to_sides(a), to_sides(b))


def _swept(polygon: Tensor, inside: Tensor) -> Tensor:
    """Solid angle swept by the edges of polygons (*, n, 2) where all distances (*, n, m) of their ends are positive."""
    return _swept_between(polygon, polygon.roll(-1, -2), inside, inside.roll(-1, -2))


def _swept_between(a: Tensor, b: Tensor, inside_a: Tensor, inside_b: Tensor) -> Tensor:
    """Sum over n of the solid angles that segments a to b (*, n, 2) sweep where they are inside of m lines."""
    change = inside_b - inside_a
    crossing = -inside_a / torch.where(change == 0, 1.0, change)
    outside = (inside_a < 0) & (inside_b < 0) | (change == 0) & (inside_a < 0)
    enter = torch.where(change > 0, crossing, 0.0).amax(-1).clamp(min=0)
    leave = torch.where(change < 0, crossing, 1.0).amin(-1).clamp(max=1)
    empty = outside.any(-1) | (enter >= leave)
    p, q = (a + (b - a) * share.unsqueeze(-1) for share in (enter, leave))
    p_length, q_length = (1 + p.square().sum(-1)).sqrt(), (1 + q.square().sum(-1)).sqrt()
    volume = p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
    angle = 2 * torch.atan2(volume, p_length * q_length + (p * q).sum(-1) + 1 + p_length + q_length)
    return torch.where(empty, 0.0, angle).sum(-1)
