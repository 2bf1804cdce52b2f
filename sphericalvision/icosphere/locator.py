# SPDX-License-Identifier: Apache-2.0
"""Point location on an icosphere: the containing triangle by descent, and barycentric weights inside it.

The midpoints of a spherical triangle's edges cut it into four spherical triangles along great circles, so
the containing triangle of level l lies inside the containing triangle of level l - 1. One base face of
twenty and one choice of four a level find it, for any number of directions at once and without a search tree.
``TriangleLocator`` does so chunk by chunk, for large tables. Faster bodies, behind ``fast/``, find a triangle by a
table of cells and a few steps across edges; results are equal up to rounding.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from sphericalvision.geometry.directions import moderate_lengths
from sphericalvision.icosphere.descent import barycentric_weights, convex, descend
from sphericalvision.icosphere.fast.triangle_table import (
    coefficients,
    corners_of_quarters,
    find_in_few_steps,
    find_triangles,
    triangle_table,
)
from sphericalvision.icosphere.mesh import icosphere_vertices
from sphericalvision.icosphere.topology import check_level, icosphere_faces, num_icosphere_vertices
from sphericalvision.kernels import Operator, prefer_fused
from sphericalvision.shapes import check_shapes
from sphericalvision.tables import constant_table

#: Rays at once, which bounds the memory in use.
CHUNK, CHUNK_ON_DEVICE = 1 << 17, 1 << 22


def chunk_size(device: torch.device) -> int:
    """Return how many rays to locate at once: on a CPU so few that they stay in the cache.

    Examples:
        >>> chunk_size(torch.device("cpu")) >= 1 << 17
        True
    """
    on_cpu = device.type == "cpu" and not prefer_fused(device)
    # torch gives a thread at least 32768 numbers.
    return max(CHUNK, torch.get_num_threads() << 15) if on_cpu else CHUNK_ON_DEVICE


@constant_table
def _faces(level: int, device: torch.device) -> Tensor:
    return icosphere_faces(level, device)  # a copy, which is kept here


def _find_by_descent(rays: Tensor, level: int) -> tuple[Tensor, Tensor]:
    unit = F.normalize(rays.T, dim=-1)
    triangles = descend(unit, level)
    return triangles.numbers(level), barycentric_weights(unit, triangles.corners).T


def _find_by_cells(rays: Tensor, level: int) -> tuple[Tensor, Tensor]:
    triangles, weights = find_triangles(rays, triangle_table(level, rays.dtype, rays.device))
    weights = weights.clamp_(min=0)
    return triangles, weights.div_(weights.sum(0))


def _find_in_few_steps(rays: Tensor, level: int) -> tuple[Tensor, Tensor]:
    return find_in_few_steps(rays, triangle_table(level, rays.dtype, rays.device))


def _weights_by_corners(rays: Tensor, triangles: Tensor, level: int) -> Tensor:
    vertices = icosphere_vertices(level, torch.float64, rays.device).to(rays.dtype)
    a, b, c = vertices[_faces(level, rays.device)[triangles]].unbind(1)
    return barycentric_weights(F.normalize(rays.T, dim=-1), (a, b, c)).T


def _weights_by_table(rays: Tensor, triangles: Tensor, level: int) -> Tensor:
    return convex(coefficients(rays, triangles, triangle_table(level, rays.dtype, rays.device)), 0)


_find = Operator(_find_by_descent, cpu=_find_by_cells, fused=_find_in_few_steps)
_weights = Operator(_weights_by_corners, cpu=_weights_by_table, fused=_weights_by_table)


class TriangleLocator:
    """Finds the triangles that rays pierce, with tables of one icosphere made once.

    Rays are columns ``(3, m)``, so that every operation runs over contiguous memory; they may be of any length but
    zero. ``locate`` is the same for directions ``(*, 3)`` of unit length or not.

    Args:
        level: subdivision level of the icosphere.
        dtype: of the rays, float32 or float64.
        device: of the rays.

    Attributes:
        faces: ``(F, 3)`` vertex ids of the triangles, those of ``icosphere_faces``.
        chunk_size: how many rays to locate at once, so few that they stay in the cache.

    Raises:
        ArgumentError: if no icosphere has this level.

    Examples:
        >>> locator = TriangleLocator(level=1)
        >>> triangles, weights = locator.find(torch.tensor([[0.0], [-2.0], [0.0]]))
        >>> locator.faces[triangles[0], weights[:, 0].argmax()]  # straight up is the north pole
        tensor(0)
    """

    def __init__(
        self, level: int, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
    ) -> None:
        self.level = check_level(level)
        device = torch.device(device)
        self.chunk_size = chunk_size(device)
        self.faces = _faces(level, device)

    def find(self, rays: Float[Tensor, "3 m"]) -> tuple[Int[Tensor, " m"], Float[Tensor, "3 m"]]:
        """Return the numbers ``(m,)`` of the triangles that rays ``(3, m)`` pierce, and the weights ``(3, m)`` there.

        A ray of zero length or with a NaN gets some triangle and NaN weights. Weights have no gradients; those of
        ``weights`` have.
        """
        with torch.no_grad():
            return _find(rays, self.level)

    def weights(self, rays: Float[Tensor, "3 m"], triangles: Int[Tensor, " m"]) -> Float[Tensor, "3 m"]:
        """Return the weights ``(3, m)`` of the corners of triangles ``(m,)``, differentiable in the rays ``(3, m)``."""
        return _weights(rays, triangles, self.level)


def triangle_corners(rays: Float[Tensor, "3 m"], level: int) -> tuple[Tensor, Tensor]:
    """Return ids and weights of the vertices around rays ``(3, m)``, ``(m, k)`` each, as ``TriangleLocator`` finds."""
    locator = TriangleLocator(level, rays.dtype, rays.device)
    triangles, weights = locator.find(rays)
    return locator.faces.index_select(0, triangles), weights.T


def _corners_by_coarser_triangle(rays: Tensor, level: int) -> tuple[Tensor, Tensor]:
    return corners_of_quarters(*_find(rays, level - 1), level - 1) if level else NotImplemented


corners_by_coarser_tables = Operator(
    triangle_corners, cpu=_corners_by_coarser_triangle, fused=_corners_by_coarser_triangle
)
"""``triangle_corners`` by tables a quarter as large; some of the k have no weight."""


@check_shapes
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
        zero length, or one that is not finite, has valid ids and NaN weights.

    References:
        Möller and Trumbore (1997), "Fast, minimum storage ray/triangle intersection", for the determinants.

    Examples:
        >>> ids, weights = locate(torch.tensor([[0.0, -2.0, 0.0], [0.0, 0.0, 1.0]]), level=0)
        >>> ids[0, weights[0].argmax()].item()  # straight up is the north pole
        0
        >>> weights.sum(-1)
        tensor([1., 1.])
    """
    check_level(level)
    ids, weights = _locate(moderate_lengths(directions.reshape(-1, 3)), level)
    return ids.view(directions.shape), weights.view(directions.shape).to(directions.dtype)


def _locate_by_descent(directions: Tensor, level: int) -> tuple[Tensor, Tensor]:
    unit = F.normalize(directions, dim=-1)
    with torch.no_grad():
        triangles = descend(unit.detach(), level)
        ids = triangles.vertex_ids(level)
    return ids, barycentric_weights(unit, triangles.corners)


def _locate_in_chunks(directions: Tensor, level: int) -> tuple[Tensor, Tensor]:
    """Locate many directions ``(M, 3)`` by a ``TriangleLocator``, whose table does not pay for few."""
    if len(directions) < 2 * num_icosphere_vertices(level):
        return NotImplemented
    locator = TriangleLocator(level, directions.dtype, directions.device)
    triangles = torch.empty(len(directions), dtype=torch.int32, device=directions.device)
    weights = torch.empty_like(directions)
    with torch.no_grad():
        for start in range(0, len(directions), locator.chunk_size):
            chunk = slice(start, start + locator.chunk_size)
            columns = torch.stack(directions[chunk].unbind(1))  # contiguous
            triangles[chunk], chunk_weights = locator.find(columns)
            for corner, weight in enumerate(chunk_weights):
                weights[chunk, corner] = weight
    ids = locator.faces.index_select(0, triangles)
    if directions.requires_grad and torch.is_grad_enabled():
        weights = locator.weights(directions.T, triangles).T.contiguous()
    return ids, weights


_locate = Operator(_locate_by_descent, cpu=_locate_in_chunks, fused=_locate_in_chunks)
