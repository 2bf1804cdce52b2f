# SPDX-License-Identifier: Apache-2.0
"""Packets of neighbouring rays, and the primitives that a packet may meet at all.

A picture is rendered in squares of pixels; the rays through one square are a packet. Tests of a whole packet against
a primitive's box are cheap and let most primitives go; what is left are pairs (packet, primitive) that are dense
enough for every ray of the packet to be intersected without picking any of them out.

Vectors of packets are stored as ``(3, b, RAYS)``, so that every operation runs over contiguous memory.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from sphericalvision.scenes.rendering.primitives import Primitives

#: Rays in a packet: a square of 16 x 16 pixels.
RAYS = 256
#: Relative and absolute widening of boxes (in half sizes of a primitive), and of origins' distances, for rounding.
MARGIN, ROUNDING = 1e-3, 1e-5
#: Distances below this (metres) are the surface that the ray starts from.
NEAREST = 1e-4
#: Distances beyond this are none.
FAR = 1e18
#: Stands in for zero where it would be divided by.
TINY = 1e-20


class RayPackets(NamedTuple):
    """Rays in groups of neighbours, mostly of `RAYS`.

    Attributes:
        origin: ``(3, b, 1)``, one for each packet, or ``(3, b, r)``; ``b`` may be 1 where all packets share it.
        direction: ``(3, b, r)``, of any length.
    """

    origin: Tensor
    direction: Tensor


class CandidatePairs(NamedTuple):
    """Pairs of a packet and a primitive that its rays may meet, sorted by primitive.

    Attributes:
        place: ``(m,)`` where the primitive is in `Primitives.columns`.
        packet: ``(m,)`` packets' numbers.
        near: ``(m,)`` whether a ray may start inside the primitive, or very near to it.
    """

    place: Tensor
    packet: Tensor
    near: Tensor


def packed(columns: Tensor) -> Tensor:
    """``(*, n)`` as ``(*, b, RAYS)``; the last packet is filled up with the last column."""
    missing = -columns.shape[-1] % RAYS
    if missing:
        columns = torch.cat([columns, columns[..., -1:].expand(*columns.shape[:-1], missing)], -1)
    return columns.reshape(*columns.shape[:-1], -1, RAYS)


def candidate_pairs(
    primitives: Primitives, rays: RayPackets, limit: Tensor | None = None, own: Tensor | None = None
) -> CandidatePairs:
    """All pairs of a packet and a primitive that are not certain to miss each other.

    Rays of a packet start in one box and have directions in another. In a primitive's own frame, where it fills
    (at most) the cube [-1, 1]³, interval arithmetic gives the earliest time at which any ray can enter a slab, and
    the latest at which any can leave it.

    Args:
        primitives: the table.
        rays: the packets.
        limit: ``(b, r)`` times at which rays end, in lengths of their directions.
        own: ``(b,)`` one row for each packet that it is known not to meet, or -1.
    """
    table = primitives.columns
    rotation = table.frame.permute(0, 2, 1).flatten(0, 1)  # rows: axis, primitive
    size = rotation.abs()
    origin, around = _box(rays.origin)
    direction, spread = _box(rays.direction)
    spread = torch.zeros_like(direction) if spread is None else spread

    def local(by: Tensor, world: Tensor) -> Tensor:
        return (by @ world).view(3, len(table.order), -1)

    # A slab is its own mirror image, so only distance and speed relative to its middle count, not the side of a packet.
    start = local(rotation, origin).sub_(table.offset[..., None])
    distance = start.abs()
    width = torch.add(table.box[..., None] + MARGIN, distance, alpha=ROUNDING)
    if around is not None:
        width += local(size, around)
    outside = distance - width
    toward = local(rotation, direction).mul_(-start.sign())  # speed towards the slab's middle
    either = local(size, spread)
    most, least = toward + either, toward.sub_(either)
    enter = outside.clamp(min=0) / most.clamp(min=TINY)
    # Reciprocals of the times of leaving: by the far side, or, having started inside, by the near one. Rays along a
    # slab never leave it, for which a reciprocal is 0 and no infinity has to be treated apart.
    rate = torch.maximum(least.div_(width + distance), most.div_(outside.clamp(max=-TINY))).amax(0)
    soonest = 1 / FAR if limit is None else limit.amax(-1).clamp_(min=TINY).reciprocal_()
    rate = torch.maximum(rate, torch.as_tensor(soonest).to(rate))
    possible = enter.amax(0).mul_(rate) <= 1  # (P, b)
    if own is not None:
        packets = (own >= 0).nonzero()[:, 0]
        possible[table.place[own[packets]], packets] = False
    place, packet = possible.nonzero(as_tuple=True)
    reachable = ((outside - NEAREST / table.half[..., None]).amax(0) <= 0).expand_as(possible)
    return CandidatePairs(place, packet, reachable[place, packet])


def _box(vectors: Tensor) -> tuple[Tensor, Tensor | None]:
    """Middle and half sizes ``(3, b)`` of boxes around packed vectors; None stands for no size."""
    if vectors.shape[-1] == 1:
        return vectors[..., 0], None
    low, high = vectors.amin(-1), vectors.amax(-1)
    return (low + high) / 2, (high - low) / 2
