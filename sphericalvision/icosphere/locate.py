# SPDX-License-Identifier: Apache-2.0
"""Point location on an icosphere: the containing triangle by descent, and barycentric weights inside it.

The midpoints of a spherical triangle's edges cut it into four spherical triangles along great circles, so
the containing triangle of level l lies inside the containing triangle of level l - 1. One base face of
twenty and one choice of four a level find it, for any number of directions at once and without a search tree.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from sphericalvision.core import ArgumentError, check_last_dim
from sphericalvision.icosphere.descent import barycentric_weights, descend
from sphericalvision.icosphere.locator import TriangleLocator, fast_wing_open
from sphericalvision.icosphere.topology import check_level, num_icosphere_vertices

__all__ = ["locate"]


def locate(
    directions: Float[Tensor, "*batch 3"], level: int
) -> tuple[Int[Tensor, "*batch 3"], Float[Tensor, "*batch 3"]]:
    """Find the triangle of an icosphere that each direction pierces, and where.

    The weights are the barycentric coordinates of the point where the ray meets the plane of the triangle:
    they are not negative, sum to one, and are differentiable in the directions. Directions on
    an edge or a vertex get one of the triangles that share it.

    Args:
        directions: ``(*, 3)`` of any length but zero, floating point; half precision is located in float32.
        level: subdivision level of the icosphere.

    Returns:
        Vertex ids ``(*, 3)``, counter-clockwise seen from outside, and weights ``(*, 3)``. A direction of
        zero length or with a NaN has valid ids and NaN weights.

    Raises:
        ShapeError: if the last dimension is not 3.
        ArgumentError: if the directions are not floating point numbers.

    References:
        Möller and Trumbore (1997), "Fast, minimum storage ray/triangle intersection", for the determinants.

    Examples:
        >>> ids, weights = locate(torch.tensor([[0.0, -2.0, 0.0], [0.0, 0.0, 1.0]]), level=0)
        >>> ids[0, weights[0].argmax()].item()  # straight up is the north pole
        0
        >>> weights.sum(-1)
        tensor([1., 1.])
    """
    check_last_dim("directions", directions, 3)
    if not directions.is_floating_point():
        raise ArgumentError(
            f"directions: expected a floating point tensor, got {directions.dtype}; use .float()"
        )
    check_level(level)
    flat = directions.reshape(-1, 3).to(torch.promote_types(directions.dtype, torch.float32))
    # A table of all triangles pays for many directions; fewer of them descend.
    if len(flat) >= 2 * num_icosphere_vertices(level) and fast_wing_open():
        ids, weights = _locate_in_chunks(flat, level)
    else:
        unit = F.normalize(flat, dim=-1)
        with torch.no_grad():
            triangles = descend(unit.detach(), level)
            ids = triangles.vertex_ids(level)
        weights = barycentric_weights(unit, triangles.corners)
    return ids.view(directions.shape), weights.view(directions.shape).to(directions.dtype)


def _locate_in_chunks(directions: Tensor, level: int) -> tuple[Tensor, Tensor]:
    """``locate`` for directions ``(M, 3)`` by a ``TriangleLocator``."""
    locator = TriangleLocator(level, directions.dtype, directions.device)
    triangles = torch.empty(len(directions), dtype=torch.int32, device=directions.device)
    weights = torch.empty_like(directions)
    with torch.no_grad():
        for start in range(0, len(directions), locator.chunk_size):
            part = slice(start, start + locator.chunk_size)
            triangles[part], found = locator.find(
                torch.stack(directions[part].unbind(1))
            )  # columns, contiguous
            for corner, weight in enumerate(found):
                weights[part, corner] = weight
    ids = locator.faces.index_select(0, triangles)
    if directions.requires_grad and torch.is_grad_enabled():
        weights = locator.weights(directions.T, triangles).T.contiguous()
    return ids, weights
