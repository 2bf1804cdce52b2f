# SPDX-License-Identifier: Apache-2.0
"""Exact intersection of rays with primitives, in plain tensor operations.

Rays go in packets of neighbours. For every pair of a packet and a primitive that may meet, all rays of the packet are
intersected; the least distance is then taken packet by packet. Only what the packet's box rules out is left out, so
the answer is that of testing every ray against every primitive.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sphericalvision.core import ShapeError, check_last_dim
from sphericalvision.scenes.rendering.intersections import HUGE, INTERSECTIONS
from sphericalvision.scenes.rendering.primitives import Primitives
from sphericalvision.scenes.rendering.ray_packets import (
    FAR,
    NEAREST,
    RAYS,
    CandidatePairs,
    RayPackets,
    candidate_pairs,
    coherent_order,
    packed,
)
from sphericalvision.scenes.rendering.surfaces import normals_and_uv

__all__ = ["Hit", "Surface", "blocked", "first_hits", "occluded", "surface", "trace"]

#: Packets looked at together, and pairs intersected together, on the CPU: few enough for a core's cache, many enough
#: for the time that an operation takes to start. Other devices take many more at once.
CHUNK, PAIRS = 192, 64


class Hit(NamedTuple):
    """First intersections.

    Attributes:
        distance: ``(*,)`` metres along the ray, inf where nothing is hit.
        primitive: ``(*,)`` row of the table, -1 where nothing is hit.
    """

    distance: Float[Tensor, "*rays"]
    primitive: Int[Tensor, "*rays"]


class Surface(NamedTuple):
    """Points on primitives.

    Attributes:
        position: ``(n, 3)`` metres.
        normal: ``(n, 3)``, unit, on the ray's side.
        uv: ``(n, 2)`` coordinates on the surface, metres.
    """

    position: Float[Tensor, "n 3"]
    normal: Float[Tensor, "n 3"]
    uv: Float[Tensor, "n 2"]


def trace(
    primitives: Primitives, origins: Float[Tensor, "*#rays 3"], directions: Float[Tensor, "*rays 3"]
) -> Hit:
    """First primitive along each ray.

    Args:
        primitives: the table to hit.
        origins: ``(3,)`` shared by all rays (fast), or ``(*, 3)``, metres.
        directions: ``(*, 3)`` unit directions.

    Returns:
        Distances and rows, both ``(*)``.

    Examples:
        >>> from sphericalvision.scenes.rendering.primitives import Part, pack
        >>> ball = pack([Part("ellipsoid", (0.0, 0.0, 3.0), (1.0, 1.0, 1.0))])
        >>> trace(ball, torch.zeros(3), torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])).distance
        tensor([2., inf])
    """
    shape = directions.shape[:-1]
    origin, direction = _columns(origins, directions)
    distance = direction.new_empty(direction.shape[1])
    primitive = torch.empty_like(distance, dtype=torch.long)
    for part, rays in _chunks(origin, direction):
        near, row = first_hits(primitives, rays)
        distance[part], primitive[part] = near.flatten()[: len(part)], row.flatten()[: len(part)]
    return Hit(distance.reshape(shape), primitive.reshape(shape))


def occluded(
    primitives: Primitives,
    origins: Float[Tensor, "*#rays 3"],
    directions: Float[Tensor, "*rays 3"],
    limits: Float[Tensor, "*rays"],
) -> Bool[Tensor, "*rays"]:
    """Whether something stands on each ray before its limit: bool ``(*)``.

    Args:
        primitives: the table to hit.
        origins: ``(3,)`` or ``(*, 3)``, metres.
        directions: ``(*, 3)`` unit directions.
        limits: ``(*)`` metres.
    """
    origin, direction = _columns(origins, directions)
    limit = limits.reshape(-1)
    answer = torch.empty_like(limit, dtype=torch.bool)
    for part, rays in _chunks(origin, direction):
        hidden = blocked(primitives, rays, packed(limit[part]))
        answer[part] = hidden.flatten()[: len(part)]
    return answer.reshape(limits.shape)


def surface(
    primitives: Primitives, origins: Float[Tensor, "... 3"], directions: Float[Tensor, "n 3"], hit: Hit
) -> Surface:
    """Where and how hit surfaces lie; every ray given must have hit something.

    Args:
        primitives: the table that was traced.
        origins: ``(3,)`` or ``(n, 3)``.
        directions: ``(n, 3)``.
        hit: their hits, each ``(n,)``.
    """
    position = origins + hit.distance[:, None] * directions
    normal, uv, _ = normals_and_uv(
        primitives, position.T.contiguous(), directions.T.contiguous(), hit.primitive
    )
    return Surface(position, normal.T, uv.T + primitives.uv_origin[hit.primitive])


def first_hits(primitives: Primitives, rays: RayPackets) -> tuple[Tensor, Tensor]:
    """Distances (in lengths of the directions) and rows of the first primitives, both ``(b, RAYS)``.

    Distances are inf, and rows -1, where nothing is hit.
    """
    nearest = torch.full_like(rays.direction[0], FAR)
    found = []
    for pairs, enter, leave in _intersections(primitives, rays, candidate_pairs(primitives, rays)):
        # A ray that starts inside a primitive has entered it in the past and meets the far side. Only pairs that may
        # hold such a ray take this detour.
        if len(inside := pairs.near.nonzero()[:, 0]):
            first, last = enter.index_select(0, inside), leave.index_select(0, inside)
            enter[inside] = torch.where(first > NEAREST, first, last)
        # A ray that leaves before it enters misses, by however little; multiplied by something huge that is a distance
        # no hit has, and a comparison and a choice are saved.
        miss = enter.clamp(min=NEAREST).sub_(leave).clamp_(min=0)
        first = enter.add_(miss, alpha=HUGE)
        packet = pairs.packet[:, None].expand_as(first)
        nearest.scatter_reduce_(0, packet, first, "amin")
        found.append((pairs, packet, first))
    which = torch.full_like(nearest, FAR)
    for pairs, packet, first in found:
        # The row where this is the nearest, and something very large elsewhere; of equals the first row counts.
        late = first.sub_(nearest.index_select(0, pairs.packet))
        row = primitives.columns.order.index_select(0, pairs.place).to(late.dtype)
        which.scatter_reduce_(0, packet, torch.add(row[:, None], late, alpha=HUGE), "amin")
    none = which >= FAR
    return nearest.masked_fill_(none, torch.inf), which.masked_fill_(none, -1).long()


def blocked(primitives: Primitives, rays: RayPackets, limit: Tensor, own: Tensor | None = None) -> Tensor:
    """Whether something stands on each ray before its limit: bool ``(b, RAYS)``.

    Args:
        primitives: the table to hit.
        rays: the packets.
        limit: ``(b, RAYS)`` in lengths of the directions.
        own: ``(b,)`` one row for each packet that it is known not to meet, or -1.
    """
    if not len(primitives):  # of a scene in which nothing casts a shadow
        return torch.zeros_like(limit, dtype=torch.bool)
    most = torch.full_like(limit, -1)  # of the lengths that rays share with primitives
    for pairs, enter, leave in _intersections(
        primitives, rays, candidate_pairs(primitives, rays, limit, own)
    ):
        end = limit.index_select(0, pairs.packet)
        shared = torch.minimum(leave, end).sub_(enter.clamp(min=NEAREST))
        if len(inside := pairs.near.nonzero()[:, 0]):
            # Of a primitive that a ray starts in only the far side counts.
            last = leave.index_select(0, inside)
            behind = torch.minimum(last - NEAREST, end.index_select(0, inside) - last)
            ahead = enter.index_select(0, inside) > NEAREST
            shared[inside] = torch.where(ahead, shared.index_select(0, inside), behind)
        most.scatter_reduce_(0, pairs.packet[:, None].expand_as(shared), shared, "amax")
    return most >= 0


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


def _chunks(origin: Tensor, direction: Tensor) -> Iterator[tuple[Tensor, RayPackets]]:
    """Packets of neighbours, and the numbers of the rays in them (without those that fill up the last packet)."""
    shared = origin.shape[1] == 1
    order = coherent_order(direction) if shared else None
    if order is None:
        order = torch.arange(direction.shape[1], device=direction.device)
    for part in order.split(chunk_size(direction.device) * RAYS):
        if len(part):
            start = origin[:, :, None] if shared else packed(origin.index_select(1, part))
            yield part, RayPackets(start, packed(direction.index_select(1, part)))


def chunk_size(device: torch.device) -> int:
    """Packets to look at together."""
    return CHUNK if device.type == "cpu" else 64 * CHUNK


def _intersections(
    primitives: Primitives, rays: RayPackets, pairs: CandidatePairs
) -> Iterator[tuple[CandidatePairs, Tensor, Tensor]]:
    """Times ``(m, r)`` at which the rays of some pairs enter and leave; enter > leave where they miss."""
    table = primitives.columns
    size = PAIRS * RAYS // rays.direction.shape[-1]
    size = size if rays.direction.device.type == "cpu" else 64 * size
    ends = torch.searchsorted(pairs.place, torch.tensor(table.starts, device=pairs.place.device)).tolist()
    for intersect, start, end in zip(INTERSECTIONS, ends, ends[1:], strict=False):
        for first in range(start, end, size):
            some = CandidatePairs(*(column[first : min(first + size, end)] for column in pairs))
            turn = table.frame.flatten(0, 1).index_select(1, some.place).view(3, 3, -1, 1)
            o = _turned(turn, _of(rays.origin, some.packet))
            o -= table.offset.index_select(1, some.place)[..., None]
            yield some, *intersect(o, _turned(turn, _of(rays.direction, some.packet)))


def _of(vectors: Tensor, packet: Tensor) -> Tensor:
    return vectors if vectors.shape[1] == 1 else vectors.index_select(1, packet)


def _turned(turn: Tensor, vectors: Tensor) -> Tensor:
    """``(3, 3, m, 1)`` times ``(3, m, n)``."""
    x = turn[:, 0] * vectors[0]
    return x.addcmul_(turn[:, 1], vectors[1]).addcmul_(turn[:, 2], vectors[2])
