# SPDX-License-Identifier: Apache-2.0
"""Patches of an icosphere: the vertices within an angle of a direction, and the rings around a vertex."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sphericalvision.core import ArgumentError, check_last_dim
from sphericalvision.geometry.directions import holds, in_single_precision, moderate_lengths
from sphericalvision.icosphere.adjacency import icosphere_neighbors
from sphericalvision.icosphere.mesh import icosphere_vertices
from sphericalvision.icosphere.topology import num_icosphere_vertices


def icosphere_within(
    directions: Float[Tensor, "*batch 3"], angle: float, level: int
) -> Bool[Tensor, "*batch V"]:
    """Return which vertices lie within an angle of each direction: geodesic discs.

    Args:
        directions: ``(*, 3)`` of any length but zero.
        angle: largest angle in radians, 0 to π.
        level: subdivision level of the icosphere.

    Returns:
        ``(*, V)`` bool.

    Examples:
        >>> up = torch.tensor([0.0, -1.0, 0.0])
        >>> icosphere_within(up, math.radians(70), level=0).nonzero().flatten()  # the pole and the ring around it
        tensor([0, 1, 3, 5, 7, 9])
    """
    check_last_dim("directions", directions, 3)
    if not 0 <= angle <= math.pi:
        raise ArgumentError(f"angle: expected 0 to π radians, got {angle!r}")
    directions = in_single_precision(directions)
    vertices = icosphere_vertices(level, directions.dtype, directions.device)
    unit = F.normalize(moderate_lengths(directions), dim=-1)
    # Chords resolve small angles, whose cosines all round to one; beyond a right angle the chord to the opposite
    # direction does. Vertices on the border belong to the disc whatever the rounding.
    narrow = angle <= math.pi / 2
    chords = torch.cdist(
        (unit if narrow else -unit).reshape(-1, 3), vertices, compute_mode="donot_use_mm_for_euclid_dist"
    ).view(*directions.shape[:-1], len(vertices))
    rounding = 4 * torch.finfo(chords.dtype).eps
    if narrow:
        return chords <= 2 * math.sin(angle / 2) + rounding
    return chords >= 2 * math.cos(angle / 2) - rounding


def icosphere_rings(
    level: int, num_rings: int, centers: Int[Tensor, " M"] | None = None
) -> Int[Tensor, "M columns"]:
    """Return each vertex with the rings of vertices around it: those at most ``num_rings`` edges away.

    Args:
        level: subdivision level of the icosphere.
        num_rings: k, 0 or more.
        centers: ``(M,)`` vertex ids; all vertices when not given.

    Returns:
        ``(M, 1 + 3 * k * (k + 1))`` vertex ids: the centre in column 0, then ring j in the next ``6 * j`` columns, in
        increasing order and with -1 last where it has fewer vertices (around the twelve vertices of valence five, and
        where rings reach round the sphere).

    Raises:
        ArgumentError: if ``num_rings`` is negative or a centre is no vertex of this level.

    Examples:
        >>> icosphere_rings(level=0, num_rings=1, centers=torch.tensor([11]))
        tensor([[11,  2,  4,  6,  8, 10, -1]])
    """
    if isinstance(num_rings, bool) or not isinstance(num_rings, int) or num_rings < 0:
        raise ArgumentError(f"num_rings: expected an integer of 0 or more, got {num_rings!r}")
    count = num_icosphere_vertices(level)
    if centers is None:
        centers = torch.arange(count)
    if centers.ndim != 1 or not holds((centers >= 0) & (centers < count)):
        raise ArgumentError(
            f"centers: expected vertex ids (M,) from 0 to {count - 1} for level {level}, got shape "
            f"{tuple(centers.shape)} with values from {centers.min().item()} to {centers.max().item()}"
        )
    neighbors = icosphere_neighbors(level, centers.device)
    rings = [centers[:, None]]
    for ring in range(1, num_rings + 1):
        last = rings[-1]
        reached = torch.where(last[..., None] < 0, -1, neighbors[last]).flatten(1)
        inner = torch.cat(rings[-2:], 1)  # what touches the last ring lies in it, in the one before or beyond
        rings.append(_unknown(reached, inner, count)[:, : 6 * ring])
    return torch.cat(rings, 1)


def _unknown(reached: Tensor, inner: Tensor, count: int) -> Tensor:
    """Return the ids in each row of ``reached`` that are not in ``inner``, each once, increasing, then -1."""
    # Even numbers are of inner ids, odd ones of those reached: of equal ids the inner one comes first.
    tagged = torch.cat((2 * inner, 2 * reached + 1), 1).sort(1).values
    ids = tagged.div(2, rounding_mode="floor")
    repeated = F.pad(ids[:, 1:] == ids[:, :-1], (1, 0))
    new = (tagged % 2 == 1) & ~repeated & (ids >= 0)
    ordered = torch.where(new, ids, count).sort(1).values
    return torch.where(ordered == count, -1, ordered)
