# SPDX-License-Identifier: Apache-2.0
"""Bundles of neighbouring rays, and the primitives that a bundle may meet at all.

A picture is rendered in squares of pixels; the rays through one square are a bundle. Tests of a whole bundle against
a primitive's box are cheap and let most primitives go; what is left are pairs (bundle, primitive) that are dense
enough for every ray of the bundle to be intersected without picking any of them out.

Vectors of bundles are stored as ``(3, b, RAYS)``, so that every operation runs over contiguous memory.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from sphericalvision.data.primitives import Primitives

__all__ = ["NEAREST", "RAYS", "Bundles", "Meetings", "bundled", "coherent_order", "meetings"]

#: Rays in a bundle: a square of 16 x 16 pixels.
RAYS = 256
#: Relative and absolute widening of boxes (in half sizes of a primitive), and of origins' distances, for rounding.
MARGIN, ROUNDING = 1e-3, 1e-5
#: Bundles whose directions spread wider than this (mean side of their box) are worth sorting.
WIDE = 0.25
#: Distances below this (metres) are the surface that the ray starts from.
NEAREST = 1e-4
#: Stands in for zero where it would be divided by.
TINY = 1e-20


class Bundles(NamedTuple):
    """Rays in groups of neighbours.

    Attributes:
        origin: ``(3, b, 1)``, one for each bundle, or ``(3, b, RAYS)``; ``b`` may be 1 where all bundles share it.
        direction: ``(3, b, RAYS)``, of any length.
    """

    origin: Tensor
    direction: Tensor


class Meetings(NamedTuple):
    """Pairs of a bundle and a primitive that its rays may meet, sorted by bundle.

    Attributes:
        bundle: ``(m,)`` bundles' numbers.
        row: ``(m,)`` rows of the table.
        near: ``(m,)`` whether a ray may start inside the primitive, or very near to it.
    """

    bundle: Tensor
    row: Tensor
    near: Tensor


def bundled(columns: Tensor) -> Tensor:
    """``(*, n)`` as ``(*, b, RAYS)``; the last bundle is filled up with the last column."""
    missing = -columns.shape[-1] % RAYS
    if missing:
        columns = torch.cat([columns, columns[..., -1:].expand(*columns.shape[:-1], missing)], -1)
    return columns.reshape(*columns.shape[:-1], -1, RAYS)


def coherent_order(direction: Tensor) -> Tensor | None:
    """A permutation ``(n,)`` that makes neighbours of rays ``(3, n)`` from one point; None where they are already."""
    count = direction.shape[1]
    if count <= RAYS:
        return None
    whole = direction[:, : count - count % RAYS].reshape(3, -1, RAYS)
    if (whole.amax(-1) - whole.amin(-1)).mean() < WIDE:
        return None
    cells = math.ceil((count / (math.pi * RAYS)) ** 0.5)  # one is about as large as a bundle should be
    x, y, z = ((direction + 1) * (cells / 2)).long().clamp(0, cells - 1)
    return ((x * cells + y) * cells + z).argsort()


def meetings(
    primitives: Primitives, rays: Bundles, limit: Tensor | None = None, own: Tensor | None = None
) -> Meetings:
    """All pairs of a bundle and a primitive that are not certain to miss each other.

    Rays of a bundle start in one box and have directions in another. In a primitive's own frame, where it fills
    (at most) the cube [-1, 1]³, interval arithmetic gives the earliest time at which any ray can enter a slab, and
    the latest at which any can leave it.

    Args:
        primitives: the table.
        rays: the bundles.
        limit: ``(b, RAYS)`` times at which rays end, in lengths of their directions.
        own: ``(b,)`` one row for each bundle that it is known not to meet, or -1.
    """
    count = rays.direction.shape[1]
    origin, around = _box(rays.origin)
    direction, spread = _box(rays.direction)
    frame = primitives.local_from_world  # (P, 3, 3)
    turn = frame.permute(1, 0, 2).reshape(-1, 3)  # rows: axis, primitive

    def local(world: Tensor, by: Tensor) -> Tensor:
        return (by @ world).view(3, len(frame), -1)

    o = local(origin, turn) - (turn * primitives.center.repeat(3, 1)).sum(-1).view(3, -1, 1)
    d, r = local(direction, turn), local(spread, turn.abs())
    away = o.abs()
    slack = local(around, turn.abs()) + away * ROUNDING + MARGIN
    half = primitives.thickness.T[:, :, None]
    outside = away - slack - half
    toward = -d * o.sign()  # speed at which the bundle's middle approaches the slab's middle
    enter = outside.clamp(min=0) / (toward + r).clamp(min=TINY)
    slow = d.abs() - r  # least speed, where all rays have the same sense
    ahead = half + slack + torch.where(toward > 0, away, -away)
    leave = torch.where(slow > 0, ahead / slow.clamp(min=TINY), torch.inf)
    end = leave.amin(0)
    if limit is not None:
        end = torch.minimum(end, limit.amax(-1))
    possible = (enter.amax(0) <= end).T  # (b, P)
    if possible.shape[0] != count:
        possible = possible.expand(count, -1)
    if own is not None:
        known = (own >= 0).nonzero()[:, 0]
        possible[known, own[known]] = False
    bundle, row = possible.nonzero(as_tuple=True)
    near = ((outside - NEAREST / primitives.half.T[:, :, None]).amax(0) <= 0).T.expand(count, -1)
    return Meetings(bundle, row, near[bundle, row])


def _box(vectors: Tensor) -> tuple[Tensor, Tensor]:
    """Middle and half sizes ``(3, b)`` of boxes around bundled vectors."""
    if vectors.shape[-1] == 1:
        return vectors[..., 0], torch.zeros_like(vectors[..., 0])
    low, high = vectors.amin(-1), vectors.amax(-1)
    return (low + high) / 2, (high - low) / 2
