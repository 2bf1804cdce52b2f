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
from jaxtyping import Float, Int
from torch import Tensor

from sphericalvision.core import check_last_dim
from sphericalvision.scenes.rendering.primitives import Primitives
from sphericalvision.scenes.rendering.ray_packets import (
    FAR,
    NEAREST,
    RAYS,
    CandidatePairs,
    RayPackets,
    candidate_pairs,
    packed,
)

#: Packets looked at together, and pairs intersected together, on the CPU: few enough for a core's cache, many enough
#: for the time that an operation takes to start. Other devices take many more at once.
CHUNK, PAIRS = 384, 128
#: Added to components of directions, so that none is zero.
TINY = 1e-20
#: Turns the least miss into a distance that no hit has.
HUGE = 1e30

Span = tuple[Tensor, Tensor]


class Hit(NamedTuple):
    """First intersections.

    Attributes:
        distance: ``(*,)`` metres along the ray, inf where nothing is hit.
        primitive: ``(*,)`` row of the table, -1 where nothing is hit.
    """

    distance: Float[Tensor, "*rays"]
    primitive: Int[Tensor, "*rays"]


def trace(primitives: Primitives, origin: Float[Tensor, " 3"], directions: Float[Tensor, "*rays 3"]) -> Hit:
    """First primitive along each ray from a point.

    Args:
        primitives: the table to hit.
        origin: ``(3,)`` metres.
        directions: ``(*, 3)`` unit directions.

    Returns:
        Distances and rows, both ``(*)``.

    Examples:
        >>> from sphericalvision.scenes.rendering.primitives import Part, pack
        >>> ball = pack([Part("ellipsoid", (0.0, 0.0, 3.0), (1.0, 1.0, 1.0))])
        >>> trace(ball, torch.zeros(3), torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])).distance
        tensor([2., inf])
    """
    check_last_dim("directions", directions, 3)
    rays, size = packed(directions.reshape(-1, 3).T.contiguous()), chunk_size(directions.device)
    chunks = [
        first_hits(primitives, RayPackets(origin[:, None, None], part.contiguous()))
        for part in rays.split(size, 1)
    ]
    distance, primitive = (
        torch.cat(column).flatten()[: directions.numel() // 3].view(directions.shape[:-1])
        for column in zip(*chunks, strict=True)
    )
    return Hit(distance, primitive)


def first_hits(primitives: Primitives, rays: RayPackets) -> tuple[Tensor, Tensor]:
    """Distances (in lengths of the directions) and rows of the first primitives, both ``(b, RAYS)``.

    Distances are inf, and rows -1, where nothing is hit.
    """
    nearest = torch.full_like(rays.direction[0], FAR)
    candidates = []
    for pairs, enter, leave in _intersections(primitives, rays, candidate_pairs(primitives, rays)):
        # A ray that starts inside a primitive has entered it in the past and meets the far side. Only pairs that may
        # hold such a ray take this detour.
        if len(inside := pairs.near.nonzero()[:, 0]):
            first, last = enter.index_select(0, inside), leave.index_select(0, inside)
            enter.index_copy_(0, inside, torch.where(first > NEAREST, first, last))
        # A ray that leaves before it enters misses. By however little it does: times HUGE (1e30) that is farther than
        # FAR (1e18), where no hit is, and 0 stays 0 for a hit. This saves a comparison and a choice for each pair.
        miss = enter.clamp(min=NEAREST).sub_(leave).clamp_(min=0)
        first = enter.add_(miss, alpha=HUGE)
        packet = pairs.packet[:, None].expand_as(first)
        nearest.scatter_reduce_(0, packet, first, "amin")
        candidates.append((pairs, packet, first))
    which = torch.full_like(nearest, FAR)
    for pairs, packet, first in candidates:
        # `scatter_reduce_` tells the least value of a ray, not whose it is. So all are asked again: each bids its row
        # of the table plus HUGE times how much later than the nearest it is. For the nearest that is the row alone (a
        # float32 holds whole numbers up to 2**24); for all others it is beyond FAR, since floats that differ at all
        # differ by more than FAR / HUGE. Of equals the first row counts; where everything missed FAR remains.
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
            in_front = enter.index_select(0, inside) > NEAREST
            shared.index_copy_(0, inside, torch.where(in_front, shared.index_select(0, inside), behind))
        most.scatter_reduce_(0, pairs.packet[:, None].expand_as(shared), shared, "amax")
    return most >= 0


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
            rotation = table.frame.flatten(0, 1).index_select(1, some.place).view(3, 3, -1, 1)
            o = _turned(rotation, picked(rays.origin, some.packet))
            o -= table.offset.index_select(1, some.place)[..., None]
            yield some, *intersect(o, _turned(rotation, picked(rays.direction, some.packet)))


def picked(vectors: Tensor, packet: Tensor) -> Tensor:
    """Vectors of some packets; those that all packets share stay."""
    return vectors if vectors.shape[1] == 1 else vectors.index_select(1, packet)


def _turned(turn: Tensor, vectors: Tensor) -> Tensor:
    """``(3, 3, m, 1)`` times ``(3, m, n)``."""
    x = turn[:, 0] * vectors[0]
    return x.addcmul_(turn[:, 1], vectors[1]).addcmul_(turn[:, 2], vectors[2])


# Where rays enter and leave the four unit shapes, in closed form. Origins (3, m, 1) or (3, m, n) and directions
# (3, m, n) are in the shapes' own frames, directions of any length. Comparisons cost more than arithmetic here, so a
# ray that misses is told by enter > leave alone.


def intersect_rectangle(o: Tensor, d: Tensor) -> Span:
    """The time at which z = 0, twice, where |x| and |y| stay below 1."""
    back = o[2] / (d[2] + TINY)
    x, y = torch.addcmul(o[:2], d[:2], back, value=-1).abs_()
    excess = torch.maximum(x, y).sub_(1).clamp_(min=0)
    time = back.neg_()
    return torch.add(time, excess, alpha=HUGE), time


def intersect_box(o: Tensor, d: Tensor) -> Span:
    """When all coordinates stay in [-1, 1]."""
    inverse = (d + TINY).reciprocal_()
    closest = o * inverse
    reach = inverse.abs_()
    enter = torch.add(closest, reach).amin(0).neg_()
    return enter, reach.sub_(closest).amin(0)


def intersect_round(o: Tensor, d: Tensor) -> Span:
    """When the coordinates' norm stays below 1; accurate from afar, too."""
    # The discriminant is taken at the point of the ray that is nearest to the centre, where everything is small; the
    # textbook's b² - 4ac subtracts two large numbers there and loses what is left of a ball seen from afar.
    inverse = d.square().sum(0).clamp_(min=1e-18).reciprocal_()
    closest = (o * d).sum(0).mul_(inverse)  # of the other sign
    room = 1 - torch.addcmul(o, d, closest, value=-1).square_().sum(0)
    miss = room.clamp(max=0)
    reach = room.clamp_(min=0).mul_(inverse).sqrt_()
    enter = (closest + reach).neg_()
    return enter.sub_(miss, alpha=HUGE), reach.sub_(closest)


def intersect_cylinder(o: Tensor, d: Tensor) -> Span:
    """When x² + z² <= 1 and |y| <= 1."""
    side_enter, side_leave = intersect_round(o[::2], d[::2])
    cap_enter, cap_leave = intersect_box(o[1:2], d[1:2])
    return torch.maximum(side_enter, cap_enter), torch.minimum(side_leave, cap_leave)


#: By shape, in the order of SHAPES.
INTERSECTIONS = (intersect_rectangle, intersect_box, intersect_round, intersect_cylinder)
