# SPDX-License-Identifier: Apache-2.0
"""Normals and surface coordinates of points on primitives."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from sphericalvision.data.primitives import SHAPES, Primitives

__all__ = ["describe"]


def describe(
    primitives: Primitives, position: Tensor, direction: Tensor, row: Tensor
) -> tuple[Tensor, Tensor]:
    """Unit normals ``(3, n)`` on the rays' side, and surface coordinates in metres ``(2, n)``, without their origin.

    Args:
        primitives: the table.
        position: ``(3, n)`` points, metres.
        direction: ``(3, n)`` of the rays that met them.
        row: ``(n,)`` the primitives that they lie on.
    """
    axes = primitives.rotation.permute(1, 2, 0).flatten(0, 1).index_select(1, row).view(3, 3, -1)
    offset = position - primitives.center.T.index_select(1, row)
    metres = axes[:, 0] * offset[0]
    metres.addcmul_(axes[:, 1], offset[1]).addcmul_(axes[:, 2], offset[2])
    half = primitives.half.T.index_select(1, row)
    # Boxes and rectangles first, for all points: the face is where the coordinate is largest.
    x, y, z = metres.abs().div_(half)
    flat = (primitives.shape == SHAPES.index("rectangle")).to(row.dtype).index_select(0, row)
    on_x = x > torch.maximum(y, z)
    on_y = (y > z) & ~on_x
    if bool(flat.any()):
        on_x &= flat == 0
        on_y &= flat == 0
    uv = torch.stack([torch.where(on_x, metres[2], metres[0]), torch.where(on_y, metres[2], metres[1])])
    face = (row * 3 + 2).sub_(on_y.long()).sub_(on_x.long(), alpha=2)
    normal = primitives.rotation.flatten(0, 1).T.contiguous().index_select(1, face)
    for name, shape in _ROUND.items():
        on = (primitives.shape == SHAPES.index(name)).index_select(0, row).nonzero()[:, 0]
        if len(on):
            sizes = half.index_select(1, on)
            local = metres.index_select(1, on)
            outward, uv[:, on] = shape(local / sizes, local, sizes)
            outward = (axes.index_select(2, on) * (outward / sizes)[:, None]).sum(0)
            normal[:, on] = outward / outward.norm(dim=0)
    away = (normal * direction).sum(0) > 0
    return torch.where(away, -normal, normal), uv


def _ellipsoid(unit: Tensor, metres: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    longitude = torch.atan2(unit[0], unit[2])
    latitude = torch.atan2(unit[1], torch.hypot(unit[0], unit[2]))
    return unit, torch.stack([longitude * half[0], latitude * half[1]])


def _cylinder(unit: Tensor, metres: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    on_cap = unit[1].abs() > torch.hypot(unit[0], unit[2])
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
