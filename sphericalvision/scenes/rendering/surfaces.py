# SPDX-License-Identifier: Apache-2.0
"""Normals and surface coordinates of points on primitives."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from sphericalvision.scenes.rendering.primitives import SHAPES, Primitives

__all__ = ["normals_and_uv"]


def normals_and_uv(
    primitives: Primitives, position: Tensor, direction: Tensor, row: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Unit normals on the rays' side, surface coordinates without their origin, and whether that side is the inner.

    A rectangle has no inner side.

    Args:
        primitives: the table.
        position: ``(3, n)`` points, metres.
        direction: ``(3, n)`` of the rays that met them.
        row: ``(n,)`` the primitives that they lie on.

    Returns:
        ``(3, n)``, ``(2, n)`` in metres, and bool ``(n,)``.
    """
    axes = primitives.rotation.permute(2, 1, 0).contiguous()  # (world, local, P)
    offset = position - primitives.center.T.index_select(1, row)
    metres = axes[0].index_select(1, row).mul_(offset[0])
    metres.addcmul_(axes[1].index_select(1, row), offset[1])
    metres.addcmul_(axes[2].index_select(1, row), offset[2])
    # Boxes and rectangles first, for all points: the face is where the coordinate is largest.
    flat = primitives.shape == SHAPES.index("rectangle")
    size = primitives.half.T.reciprocal()
    size[:2, flat] = 0
    x, y, z = metres.abs().mul_(size.index_select(1, row))
    on_x = x > torch.maximum(y, z)
    on_y = (y > z).logical_and_(~on_x)
    uv = torch.stack([torch.where(on_x, metres[2], metres[0]), torch.where(on_y, metres[2], metres[1])])
    face = (row * 3 + 2).sub_(on_y.long()).sub_(on_x.long(), alpha=2)
    normal = primitives.rotation.flatten(0, 1).T.contiguous().index_select(1, face)
    for name, shape in _ROUND.items():
        rows = primitives.shape == SHAPES.index(name)
        on = rows.index_select(0, row).nonzero()[:, 0] if bool(rows.any()) else row[:0]
        if len(on):
            which = row.index_select(0, on)
            half = primitives.half.T.index_select(1, which)
            local = metres.index_select(1, on)
            outward, along = shape(local / half, local, half)
            outward /= half
            x, y, z = ((axes[k].index_select(1, which) * outward).sum(0) for k in (0, 1, 2))
            length = (x * x).addcmul_(y, y).addcmul_(z, z).rsqrt_()
            normal.index_copy_(1, on, torch.stack([x, y, z]).mul_(length))
            uv.index_copy_(1, on, along)
    away = (normal * direction).sum(0) > 0
    normal.mul_(1 - 2 * away.to(normal.dtype))
    return normal, uv, away.logical_and_(~flat.index_select(0, row))


def _ellipsoid(unit: Tensor, metres: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    longitude = torch.atan2(unit[0], unit[2])
    latitude = torch.atan2(unit[1], _across(unit))
    return unit.clone(), torch.stack([longitude * half[0], latitude * half[1]])


def _across(unit: Tensor) -> Tensor:
    """Distance from the local y axis, for coordinates of the order of 1."""
    return (unit[0] * unit[0]).addcmul_(unit[2], unit[2]).sqrt_()


def _cylinder(unit: Tensor, metres: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    on_cap = unit[1].abs() > _across(unit)
    side = torch.stack([unit[0], torch.zeros_like(unit[1]), unit[2]])
    cap = torch.zeros_like(unit)
    cap[1] = unit[1].sign()
    around = torch.stack([torch.atan2(unit[0], unit[2]) * half[0], metres[1]])
    return torch.where(on_cap, cap, side), torch.where(on_cap, metres[::2], around)


#: Unit shapes' normals (of any length) and surface coordinates in metres.
_ROUND: dict[str, Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]] = {
    "ellipsoid": _ellipsoid,
    "cylinder": _cylinder,
}
