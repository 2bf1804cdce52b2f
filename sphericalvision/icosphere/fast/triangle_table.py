# SPDX-License-Identifier: Apache-2.0
"""Tables of an icosphere's triangles for many rays: matrices of weights, neighbours, and cells to start from.

A ray is a combination of the corners of a triangle, and a 3 x 3 matrix gives its coefficients. Divided by their sum
they are the weights; where all are positive the ray goes through the triangle, and where one is not, through a
triangle beyond the edge opposite to that corner. Vectors are columns ``(3, m)``, so that every operation runs over
contiguous memory.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from sphericalvision.geometry.lookup import read_entries
from sphericalvision.icosphere.adjacency import icosphere_face_neighbors
from sphericalvision.icosphere.descent import convex, descend
from sphericalvision.icosphere.fast.octahedron import cell_centers, cell_numbers
from sphericalvision.icosphere.mesh import icosphere_vertices
from sphericalvision.icosphere.topology import chart_vertex_ids, icosphere_faces
from sphericalvision.tables import constant_table

#: Cells along an edge of the octahedron: six for each triangle up to so many, at finer levels one and a half: a cell is
#: always smaller than a triangle.
CELLS, MANY_CELLS, FEWEST = 8, 512, 4
#: Steps across edges before the descent is used instead.
STEPS = 16
#: Steps where the loop cannot depend on the rays, as in exported programs: around a corner from the middle of a cell.
FEW_STEPS = 3
#: Level up to which the triangles of cells are found by the descent.
FIRST = 1


class TriangleTable(NamedTuple):
    """What does not depend on the rays, for the T triangles of ``icosphere_faces``."""

    level: int
    ids: Tensor  # (T, 3) vertices
    matrices: Tensor  # (3, 3, T): component of a ray, corner, triangle
    neighbors: Tensor  # (3 * T,) triangles opposite to the corners 0, 1, 2 of each
    cells: Tensor  # (2 * resolution²,) triangle in the middle of each cell
    resolution: int


@constant_table
@lru_cache(maxsize=4)  # where they are too large to be kept for ever
def triangle_table(level: int, dtype: torch.dtype, device: torch.device) -> TriangleTable:
    """Return the table of a level; matrices are exact in float64 and kept in ``dtype``.

    Examples:
        >>> table = triangle_table(1, torch.float32, torch.device("cpu"))
        >>> triangles, shares = find_triangles(torch.tensor([[0.0], [-2.0], [0.0]]), table)
        >>> table.ids[triangles[0], shares[:, 0].argmax()].item()  # straight up is the north pole
        0
    """
    table = _without_cells(level, dtype)
    cells = _cells(_without_cells(level, torch.float32) if dtype != torch.float32 else table)
    ids, matrices, neighbors, cells = (
        tensor.to(device) for tensor in (table.ids, table.matrices, table.neighbors, cells)
    )
    return TriangleTable(level, ids, matrices, neighbors, cells, _resolution(level))


def find_triangles(
    rays: Float[Tensor, "3 m"], table: TriangleTable, guess: Int[Tensor, " m"] | None = None
) -> tuple[Int[Tensor, " m"], Float[Tensor, "3 m"]]:
    """Return the triangles ``(m,)``, int32, that rays ``(3, m)`` pierce, and their coefficients ``(3, m)``.

    Args:
        rays: of any length; one of zero length or with a NaN gets some triangle.
        table: in the dtype and on the device of the rays.
        guess: triangles ``(m,)`` to begin with, changed in place; those of the rays' cells when not given.
    """
    if guess is None:
        guess = table.cells.index_select(0, cell_numbers(rays, table.resolution))
    triangles, shares = guess, coefficients(rays, guess, table)
    if rays.is_meta:  # only shapes: which rays lie elsewhere is unknown
        return triangles, shares
    outside = _outside(shares, table.level)
    where, astray, now, weights = outside, rays, triangles, shares
    # Fewer and fewer rays are astray: each round looks at those alone that are, `where` among all rays they stand.
    for _ in range(STEPS):
        if not len(outside):
            return triangles, shares
        astray, weights = read_entries(astray, outside), read_entries(weights, outside)
        # Across the edge opposite to the corner of the least coefficient: 0 where that is a's, and else 1 for b's or
        # 2 for c's. Three comparisons of whole rows, where argmin would go through columns of three one by one.
        a, b, c = weights
        least = ((b < a) | (c < a)).int().mul_((c < b).int().add_(1))
        step = now.index_select(0, outside).mul_(3).add_(least)
        now = table.neighbors.index_select(0, step)
        weights = coefficients(astray, now, table)
        triangles.index_copy_(0, where, now)
        for share, part in zip(shares, weights, strict=True):
            share.index_copy_(0, where, part)
        outside = _outside(weights, table.level)
        where = where.index_select(0, outside)
    unit = F.normalize(rays.index_select(1, where).T, dim=-1)
    triangles[where] = descend(unit, table.level).numbers(table.level).int()
    shares[:, where] = coefficients(rays[:, where], triangles[where], table)
    return triangles, shares


def find_in_few_steps(
    rays: Float[Tensor, "3 m"], table: TriangleTable
) -> tuple[Int[Tensor, " m"], Float[Tensor, "3 m"]]:
    """Return what ``find_triangles`` does, and weights that add up to one, by as many operations for any rays.

    A cell is smaller than a triangle, so that none is farther than around a corner from the one in its middle.
    """
    cells, resolution = _large_cells(table.level, rays.dtype, rays.device)
    half = resolution / 2
    x, y, z = rays = rays * (half / rays.abs().sum(0))  # of one size, so that rounding is
    across = torch.stack((x + z, x - z)) + half
    row, column = across.int().clamp(0, resolution - 1)
    row = row.add(y < 0, alpha=resolution)
    triangles = cells.index_select(0, column.add(row, alpha=resolution))
    matrices = _matrix_rows(table.level, rays.dtype, rays.device)
    slack = 8 * 2**table.level * torch.finfo(rays.dtype).eps * half
    columns = rays.T[:, :, None]
    for step in range(FEW_STEPS + 1):
        weights = (matrices.index_select(0, triangles).view(-1, 3, 3) * columns).sum(1)
        if step < FEW_STEPS:
            least, corner = weights.min(1)
            neighbors = table.neighbors.index_select(0, corner.add(triangles, alpha=3))
            triangles = neighbors.where(least < -slack, triangles)
    return triangles, convex(weights, 1).T


def corners_of_quarters(
    triangles: Int[Tensor, " m"], weights: Float[Tensor, "3 m"], level: int
) -> tuple[Int[Tensor, "m 4"], Float[Tensor, "m 4"]]:
    """Return vertices of the next finer level, ``(m, 4)``, and the weights with which they add up to rays.

    Great circles through the middles of its edges split a triangle in four. A ray is in that at a corner if the corner
    has more than half of the weight. So three middles and a corner are enough, and one of them has no weight.
    """
    ids, cosines = _halves(level, weights.dtype, weights.device)
    vertices = ids.index_select(0, triangles)
    corner = weights.max(0).indices
    rest = torch.minimum(weights, 1 - weights)  # what the corner leaves to the middles
    total = rest.sum(0, keepdim=True)
    # The sum of two corners is longer than the unit vector to their middle, by twice the cosine of half their angle.
    middles = (total - 2 * rest) * cosines.index_select(1, triangles)
    vertices = torch.cat((vertices[:, 3:], vertices.gather(1, corner[:, None])), 1)
    return vertices, convex(torch.cat((middles, 1 - total)), 0).T


@constant_table
def _large_cells(level: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, int]:
    """Cells of ``triangle_table``, but so large that programs and devices need few, and their resolution."""
    table = triangle_table(level, dtype, device)
    resolution = FEWEST * 2**level
    size = table.resolution // resolution
    cells = table.cells.view(2, resolution, size, resolution, size)[:, :, size // 2, :, size // 2]
    return cells.flatten(), resolution


@constant_table
def _halves(level: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Ids ``(T, 6)`` at the next level of corners and of the middles opposite to them, and cosines ``(3, T)``."""
    # The two triangles of a cell, by the 3 x 3 vertices that it has at the next level, in rows
    cells = chart_vertex_ids(level + 1).unfold(1, 3, 2).unfold(2, 3, 2).flatten(3)
    ids = cells[..., torch.tensor([[0, 2, 6, 4, 3, 1], [8, 6, 2, 4, 5, 7]])].view(-1, 6)
    corners, middles = icosphere_vertices(level + 1, torch.float64)[ids].split(3, 1)
    cosines = (middles * corners.roll(-1, 1)).sum(-1).T.contiguous()
    return ids.to(device), cosines.to(device, dtype)


@constant_table
def _matrix_rows(level: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Matrices of ``triangle_table``, each contiguous in memory: ``(T, 9)``."""
    return triangle_table(level, dtype, device).matrices.view(9, -1).T.contiguous()


def coefficients(
    rays: Float[Tensor, "3 m"], triangles: Int[Tensor, " m"], table: TriangleTable
) -> Float[Tensor, "3 m"]:
    """Return coefficients ``(3, m)`` with which the corners of triangles ``(m,)`` add up to rays ``(3, m)``."""
    x, y, z = read_entries(table.matrices.view(9, -1), triangles.long()).view(3, 3, -1)
    return (x * rays[0]).addcmul_(y, rays[1]).addcmul_(z, rays[2])


def _outside(shares: Tensor, level: int) -> Tensor:
    """Numbers of the columns with a weight below zero by more than rounding; a NaN is none."""
    a, b, c = shares
    slack = (a + b).add_(c).mul_(8 * 2**level * torch.finfo(shares.dtype).eps)
    return slack.add_(shares.amin(0)).lt(0).nonzero()[:, 0]


def _resolution(level: int) -> int:
    return max(min(CELLS * 2**level, MANY_CELLS), FEWEST * 2**level)


def _without_cells(level: int, dtype: torch.dtype) -> TriangleTable:
    ids = icosphere_faces(level)
    vertices = icosphere_vertices(level, torch.float64).T.contiguous()
    x, y, z = corners = vertices.index_select(1, ids.T.flatten()).view(3, 3, -1)
    matrices = torch.empty(3, 3, len(ids), dtype=dtype)
    for corner in range(3):
        b, c = (corner + 1) % 3, (corner + 2) % 3
        # Products with differences, which are accurate: b x c = b x (c - b), and a . (b x c) = (a - b) . (b x c).
        u, v, w = corners[:, c] - corners[:, b]
        normal = y[b] * w - z[b] * v, z[b] * u - x[b] * w, x[b] * v - y[b] * u
        u, v, w = corners[:, corner] - corners[:, b]
        volume = normal[0] * u + normal[1] * v + normal[2] * w
        for component in range(3):
            matrices[component, corner] = normal[component] / volume
    opposite = icosphere_face_neighbors(level).roll(-1, 1).int().flatten()  # edge 12 is opposite to corner 0
    return TriangleTable(level, ids, matrices, opposite, ids.new_empty(0), 0)


def _cells(table: TriangleTable) -> Tensor:
    """Triangles in the middle of the cells, found from those of the coarser level."""
    level, resolution = table.level, _resolution(table.level)
    centers = cell_centers(resolution)
    if level <= FIRST:
        return descend(F.normalize(centers.T, dim=-1), level).numbers(level).int()
    coarser = _without_cells(level - 1, torch.float32)
    rows = _resolution(level - 1)
    parents = _cells(coarser).view(2, rows, 1, rows, 1)
    repeats = resolution // rows
    parents = parents.expand(-1, -1, repeats, -1, repeats).flatten()
    return find_triangles(centers, table, _children(centers, parents, coarser))[0]


def _children(rays: Tensor, parents: Tensor, table: TriangleTable) -> Tensor:
    """Triangles of the next level about where rays ``(3, m)`` pierce their parents, triangles ``(m,)`` of a table."""
    weights = coefficients(rays, parents, table)
    # The corner that has more than half of the weight (outside, two may have); else the middle, which is turned.
    first, second, third = weights.gt(weights.sum(0).div_(2)).int()
    second -= first * second
    third -= (first + second) * third
    n, half, place = 2**table.level, parents & 1, parents >> 1
    sign = 1 - 2 * half
    row = (place >> table.level).mul_(2).add_(half).addcmul_(sign, third)
    column = (place & n - 1).mul_(2).add_(half).addcmul_(sign, second)
    center = 1 - first.add_(second).add_(third)
    return row.mul_(2 * n).add_(column).mul_(2).add_(half).addcmul_(sign, center)
