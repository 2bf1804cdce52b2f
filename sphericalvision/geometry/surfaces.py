# SPDX-License-Identifier: Apache-2.0
"""Intersection of rays with a surface given as depth around one point."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

STEPS, HALVINGS = 64, 12
AT_ONCE = 2**19
"""Points looked up together: locating many on an icosphere is faster per point."""
FARTHEST = 1e4
"""Nearest depths; beyond, the parallax of a rig's camera is negligible."""


def distance_along(
    rays: Float[Tensor, "n 3"],
    start: Float[Tensor, " 3"],
    inverse_depth: Callable[[Tensor], Tensor],
    min_depth: float,
) -> Float[Tensor, " n"]:
    """Return the distance ``(n,)`` at which each ray first passes the surface; NaN where it never does.

    A point p is behind the surface where |p| · w(p / |p|) > 1. A ray is followed in even steps of inverse distance, the
    spacing of hypotheses, until a point is behind; then the interval is bisected. Where depth is unknown the ray
    continues, and can only meet the surface after it was in front again.

    Args:
        rays: ``(n, 3)`` unit directions.
        start: ``(3,)`` of all rays, from the point that depth is measured around, metres.
        inverse_depth: of the surface, 1/m, ``(n,)`` in unit directions ``(n, 3)``; NaN where unknown.
        min_depth: metres; the surface is nowhere nearer.

    Examples:
        >>> ball = lambda directions: torch.full((len(directions),), 0.5)  # of 2 m
        >>> distance_along(torch.eye(3), torch.tensor([1.0, 0.0, 0.0]), ball, min_depth=1.0).round(decimals=3)
        tensor([1.0000, 1.7320, 1.7320])
    """

    def front_of(distances: Tensor, which: Tensor) -> Tensor:
        """The share of the way to the surface that is left ``(*k, n)``: negative behind it, NaN where unknown."""
        points = (start + distances[..., None] * rays[which]).reshape(-1, 3)
        norm = points.norm(dim=-1)
        margin = 1 - norm * inverse_depth(points / norm.clamp(min=1e-9)[:, None])
        return margin.view(distances.shape)

    nearest = max(min_depth - float(start.norm()), 0.05 * min_depth)
    steps = 1 / torch.linspace(1 / nearest, 1 / (FARTHEST * min_depth), STEPS, dtype=torch.float64)
    steps = torch.cat((steps.new_zeros(1), steps)).to(rays)
    waiting = torch.arange(len(rays), device=rays.device)
    # Rays of a rig's camera begin in front of the surface; others may begin behind it.
    in_front = ~(front_of(steps[:1, None].expand(-1, len(waiting)), waiting)[0] < 0)
    low, high = rays.new_full((2, len(rays)), math.nan)
    first = 1
    while first < len(steps) and len(waiting):
        last = min(first + max(1, AT_ONCE // len(waiting)), len(steps))
        margins = front_of(steps[first:last, None].expand(-1, len(waiting)), waiting)
        was = torch.cat((in_front[None], margins[:-1] > 0))
        met = was & (margins <= 0)
        which, hit = met.int().argmax(0) + first, met.any(0)
        low[waiting[hit]], high[waiting[hit]] = steps[which[hit] - 1], steps[which[hit]]
        waiting, in_front, first = waiting[~hit], (margins[-1] > 0)[~hit], last
    hits = high.isfinite().nonzero()[:, 0]
    near, far = low[hits], high[hits]
    for _ in range(HALVINGS):
        bisected = _between(near, far)
        front = front_of(bisected, hits) > 0
        near, far = torch.where(front, bisected, near), torch.where(front, far, bisected)
    distance = rays.new_full((len(rays),), math.nan)
    distance[hits] = _between(near, far)
    return distance


def _between(near: Tensor, far: Tensor) -> Tensor:
    """The middle in inverse distance, as the steps are spaced; the first step begins at zero, where there is none."""
    return torch.where(near > 0, 2 / (1 / near.clamp(min=1e-9) + 1 / far), far / 2)
