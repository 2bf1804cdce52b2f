# SPDX-License-Identifier: Apache-2.0
"""Exact intersection of rays with primitives, in plain tensor operations.

Rays are cut into chunks that stay in the cache. Where they start from one point, only primitives whose bounding sphere
meets the cone around the chunk are looked at, so it pays to give neighbouring rays one after the other. Large flat
rectangles (walls) are tested densely; for the other shapes one matrix product against the bounding spheres finds the
few (primitive, ray) pairs worth an exact test. Internally vectors are stored as ``(3, n)``, so that every operation
runs over contiguous memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from sphericalvision.core import ShapeError, check_last_dim
from sphericalvision.data.primitives import Primitives

__all__ = ["Hit", "Surface", "occluded", "surface", "trace"]

#: Rays in a chunk on the CPU; other devices take many more at once.
CHUNK = 8192
#: Radians that a cone around rays is widened by, for rounding.
CONE_MARGIN = 1e-3
#: Distances below this (metres) are the surface that the ray starts from.
NEAREST = 1e-4


class Hit(NamedTuple):
    """First intersections.

    Attributes:
        distance: ``(*,)`` metres along the ray, inf where nothing is hit.
        primitive: ``(*,)`` row of the table, -1 where nothing is hit.
    """

    distance: Tensor
    primitive: Tensor


class Surface(NamedTuple):
    """Points on primitives.

    Attributes:
        position: ``(n, 3)`` metres.
        normal: ``(n, 3)``, unit, on the ray's side.
        uv: ``(n, 2)`` coordinates on the surface, metres.
    """

    position: Tensor
    normal: Tensor
    uv: Tensor


def trace(primitives: Primitives, origins: Tensor, directions: Tensor) -> Hit:
    """First primitive along each ray.

    Args:
        primitives: the table to hit.
        origins: ``(3,)`` shared by all rays (fast), or ``(*, 3)``, metres.
        directions: ``(*, 3)`` unit directions.

    Returns:
        Distances and rows, both ``(*)``.

    Examples:
        >>> from sphericalvision.data.primitives import Part, pack
        >>> ball = pack([Part("ellipsoid", (0.0, 0.0, 3.0), (1.0, 1.0, 1.0))])
        >>> trace(ball, torch.zeros(3), torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])).distance
        tensor([2., inf])
    """
    shape = directions.shape[:-1]
    origin, direction = _columns(origins, directions)
    distance, primitive = [], []
    for o, d in _chunks(origin, direction):
        nearest = torch.full_like(d[0], torch.inf)
        which = torch.full_like(d[0], -1, dtype=torch.long)
        pairs: list[tuple[Tensor, Tensor, Tensor]] = []
        for name, rows, table in _within_reach(primitives, o, d):
            if name == "rectangle":
                nearest, column = _rectangles(table, o, d).min(0)
                which = torch.where(nearest.isfinite(), rows[column], which)
                continue
            row, ray = _candidates(table, o, d)
            enter, leave = _intervals(name, table, o, d, row, ray)
            first = torch.where(enter > NEAREST, enter, leave)
            met = ((enter <= leave) & (leave > NEAREST)).nonzero()[:, 0]
            pairs.append((first[met], ray[met], rows[row[met]]))
        if pairs:
            first, ray, row = (torch.cat(column) for column in zip(*pairs, strict=True))
            nearest = nearest.scatter_reduce(0, ray, first, "amin")
            won = first == nearest[ray]
            which[ray[won]] = row[won]
        distance.append(nearest)
        primitive.append(which)
    return Hit(torch.cat(distance).reshape(shape), torch.cat(primitive).reshape(shape))


def occluded(primitives: Primitives, origins: Tensor, directions: Tensor, limits: Tensor) -> Tensor:
    """Whether something stands on each ray before its limit: bool ``(*)``.

    Args:
        primitives: the table to hit.
        origins: ``(3,)`` or ``(*, 3)``, metres.
        directions: ``(*, 3)`` unit directions.
        limits: ``(*)`` metres.
    """
    origin, direction = _columns(origins, directions)
    limit = limits.reshape(-1)
    answer, start = [], 0
    for o, d in _chunks(origin, direction):
        end = limit[start : start + d.shape[1]]
        start += d.shape[1]
        blocked = torch.zeros_like(d[0], dtype=torch.bool)
        for name, _, table in _within_reach(primitives, o, d):
            if name == "rectangle":
                blocked |= (_rectangles(table, o, d) < end).any(0)
                continue
            row, ray = _candidates(table, o, d)
            enter, leave = _intervals(name, table, o, d, row, ray)
            first = torch.where(enter > NEAREST, enter, leave)
            blocked[ray[(enter <= leave) & (first > NEAREST) & (first < end[ray])]] = True
        answer.append(blocked)
    return torch.cat(answer).reshape(limits.shape)


def surface(primitives: Primitives, origins: Tensor, directions: Tensor, hit: Hit) -> Surface:
    """Where and how hit surfaces lie; every ray given must have hit something.

    Args:
        primitives: the table that was traced.
        origins: ``(3,)`` or ``(n, 3)``.
        directions: ``(n, 3)``.
        hit: their hits, each ``(n,)``.
    """
    row = hit.primitive
    position = origins + hit.distance[:, None] * directions
    axes = primitives.rotation[row].permute(1, 2, 0).contiguous()
    half = primitives.half[row].T.contiguous()
    metres = (axes * (position - primitives.center[row]).T[None]).sum(1)
    unit = metres / half
    normal, uv = torch.empty_like(unit), torch.empty_like(unit[:2])
    kind = primitives.shape[row]
    for k, describe in enumerate(_DESCRIBE):
        on = (kind == k).nonzero()[:, 0]
        if len(on):
            normal[:, on], uv[:, on] = describe(unit[:, on], metres[:, on], half[:, on])
    normal = (axes * (normal / half)[:, None]).sum(0).T
    normal = normal / normal.norm(dim=-1, keepdim=True)
    away = (normal * directions).sum(-1, keepdim=True) > 0
    return Surface(position, torch.where(away, -normal, normal), uv.T + primitives.uv_origin[row])


def _columns(origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Rays as ``(3, 1 or n)`` and ``(3, n)``."""
    check_last_dim("directions", directions, 3)
    check_last_dim("origins", origins, 3)
    if origins.ndim > 1 and origins.shape != directions.shape:
        raise ShapeError(
            f"origins: expected (3,) or the shape of directions {tuple(directions.shape)}, "
            f"got {tuple(origins.shape)}"
        )
    return origins.reshape(-1, 3).T.contiguous(), directions.reshape(-1, 3).T.contiguous()


def _chunks(origin: Tensor, direction: Tensor) -> list[tuple[Tensor, Tensor]]:
    size = CHUNK if direction.device.type == "cpu" else 64 * CHUNK
    parts = [part.contiguous() for part in direction.split(size, 1)]
    shared = origin.shape[1] == 1
    return list(zip([origin] * len(parts) if shared else origin.split(size, 1), parts, strict=True))


def _within_reach(
    primitives: Primitives, origin: Tensor, direction: Tensor
) -> Iterator[tuple[str, Tensor, Primitives]]:
    """By shape: row numbers and table of the primitives that rays of this chunk may meet."""
    shared = (
        origin.shape[1] == 1 and direction.device.type == "cpu"
    )  # elsewhere waiting for an answer costs more
    if not shared or not direction.shape[1]:
        for name, (rows, table) in primitives.by_shape.items():
            yield name, rows, table
        return
    axis = torch.nn.functional.normalize(direction.sum(1), dim=0)
    opening = (axis @ direction).min().clamp(-1, 1).acos()
    for name, (rows, table) in primitives.by_shape.items():
        offset = table.center - origin.T
        distance = offset.square().sum(-1).sqrt()
        size = (table.radius / distance).clamp(max=1).asin()
        angle = (offset @ axis / distance).clamp(-1, 1).acos()
        near = ((distance <= table.radius) | ~(angle > opening + size + CONE_MARGIN)).nonzero()[:, 0]
        if len(near) == len(rows):
            yield name, rows, table
        elif len(near):
            yield name, rows[near], table.select(near)


def _rectangles(table: Primitives, origin: Tensor, direction: Tensor) -> Tensor:
    """Distances ``(P, n)`` to every rectangle; inf where missed."""
    local_from_world = table.local_from_world.permute(1, 0, 2)
    offset = (local_from_world * table.center).sum(-1)[:, :, None]
    dx, dy, dz = (local_from_world @ direction).unbind(0)
    ox, oy, oz = (local_from_world @ origin - offset).unbind(0)
    distance = -oz / dz
    inside = torch.maximum((ox + distance * dx).abs(), (oy + distance * dy).abs()) <= 1
    return torch.where(inside & (distance > NEAREST), distance, torch.inf)


def _candidates(table: Primitives, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Pairs (row, ray) of rays that meet the primitives' bounding spheres."""
    if origin.shape[1] == 1:
        offset = table.center - origin.T
        margin = offset.square().sum(-1) - table.radius.square()
        least = torch.where(margin > 0, margin.clamp(min=0).sqrt(), -torch.inf)
        near = offset @ direction >= least[:, None]
    else:
        along = table.center @ direction - (origin * direction).sum(0)
        center_squared = table.center.square().sum(-1) - table.radius.square()
        margin = origin.square().sum(0) - 2 * (table.center @ origin) + center_squared[:, None]
        near = (margin <= 0) | ((along > 0) & (along.square() >= margin))
    row, ray = near.nonzero(as_tuple=True)
    return row, ray


def _intervals(
    name: str, table: Primitives, origin: Tensor, direction: Tensor, row: Tensor, ray: Tensor
) -> tuple[Tensor, Tensor]:
    """Distances at which each pair's ray enters and leaves its primitive; enter > leave where it misses."""
    local_from_world = table.local_from_world.permute(1, 2, 0).contiguous()
    turn = local_from_world.index_select(2, row)
    d = (turn * direction.index_select(1, ray)).sum(1)
    if origin.shape[1] == 1:
        o = (local_from_world * (origin - table.center.T)).sum(1).index_select(1, row)
    else:
        o = (turn * (origin.index_select(1, ray) - table.center.T.index_select(1, row))).sum(1)
    return _INTERVAL[name](o, d)


def _slab_interval(o: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
    """Interval in which all coordinates stay in [-1, 1]."""
    inverse = torch.where(d.abs() < 1e-9, 1e-9, d).reciprocal()
    middle, reach = -o * inverse, inverse.abs()
    return (middle - reach).amax(0), (middle + reach).amin(0)


def _round_interval(o: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
    """Interval in which the coordinates' norm stays below 1; accurate from afar, too."""
    squared = d.square().sum(0).clamp(min=1e-18)
    middle = -(o * d).sum(0) / squared
    room = 1 - (o + middle * d).square().sum(0)
    reach = (room.clamp(min=0) / squared).sqrt()
    return torch.where(room > 0, middle - reach, torch.inf), middle + reach


def _cylinder_interval(o: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
    side_enter, side_leave = _round_interval(o[::2], d[::2])
    cap_enter, cap_leave = _slab_interval(o[1:2], d[1:2])
    return torch.maximum(side_enter, cap_enter), torch.minimum(side_leave, cap_leave)


_INTERVAL: dict[str, Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]] = {
    "box": _slab_interval,
    "ellipsoid": _round_interval,
    "cylinder": _cylinder_interval,
}


def _describe_rectangle(unit: Tensor, metres: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    normal = torch.zeros_like(unit)
    normal[2] = 1
    return normal, metres[:2]


def _describe_box(unit: Tensor, metres: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    x, y, z = unit.abs()
    on_x, on_y = (x >= y) & (x >= z), (y > x) & (y >= z)
    normal = torch.stack([on_x, on_y, ~(on_x | on_y)]) * unit.sign()
    return normal, torch.stack(
        [torch.where(on_x, metres[2], metres[0]), torch.where(on_y, metres[2], metres[1])]
    )


def _describe_ellipsoid(unit: Tensor, metres: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    longitude = torch.atan2(unit[0], unit[2])
    latitude = torch.atan2(unit[1], torch.hypot(unit[0], unit[2]))
    return unit, torch.stack([longitude * half[0], latitude * half[1]])


def _describe_cylinder(unit: Tensor, metres: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    on_cap = unit[1].abs() > torch.hypot(unit[0], unit[2])
    side = torch.stack([unit[0], torch.zeros_like(unit[1]), unit[2]])
    cap = torch.zeros_like(unit)
    cap[1] = unit[1].sign()
    around = torch.stack([torch.atan2(unit[0], unit[2]) * half[0], metres[1]])
    return torch.where(on_cap, cap, side), torch.where(on_cap, metres[::2], around)


#: Unit shapes' normals (of any length) and surface coordinates in metres, in the order of SHAPES.
_DESCRIBE = (_describe_rectangle, _describe_box, _describe_ellipsoid, _describe_cylinder)
