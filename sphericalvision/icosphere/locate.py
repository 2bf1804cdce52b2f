# SPDX-License-Identifier: Apache-2.0
"""Point location on an icosphere: the containing triangle by descent, and barycentric weights inside it.

The midpoints of a spherical triangle's edges cut it into four spherical triangles along great circles, so
the containing triangle of level l lies inside the containing triangle of level l - 1. One base face of
twenty and one choice of four a level find it, for any number of directions at once and without a search tree.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from sphericalvision.core import ArgumentError, check_last_dim
from sphericalvision.icosphere.mesh import icosahedron_rectangles
from sphericalvision.icosphere.topology import check_level, icosphere_faces, vertex_at

__all__ = ["locate"]


def locate(directions: Tensor, level: int) -> tuple[Tensor, Tensor]:
    """Find the triangle of an icosphere that each direction pierces, and where.

    The weights are the barycentric coordinates of the point where the ray meets the plane of the triangle:
    they sum to one, are non-negative up to rounding, and are differentiable in the directions. Directions on
    an edge or a vertex get one of the triangles that share it.

    Args:
        directions: ``(*, 3)`` of any length but zero, floating point.
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
    unit = F.normalize(directions.reshape(-1, 3), dim=-1)
    with torch.no_grad():
        ids, corners = _descend(unit.detach(), level)
    weights = _barycentric_weights(unit, corners)
    return ids.view(directions.shape), weights.view(directions.shape)


def _barycentric_weights(unit: Tensor, corners: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    """Return ``(M, 3)`` weights from determinants of small differences, which are accurate in float32."""
    a, b, c = (corner - unit for corner in corners)
    volumes = torch.stack((_triple(unit, b, c), _triple(unit, c, a), _triple(unit, a, b)), -1)
    return volumes / volumes.sum(-1, keepdim=True)


def _triple(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Return the determinant of the rows a, b, c, each ``(M, 3)``."""
    return (a * torch.linalg.cross(b, c)).sum(-1)


def _descend(unit: Tensor, level: int) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
    """Return the vertex ids ``(M, 3)`` and the corner positions of the containing triangles.

    A triangle is its corner 0 at a place (row, column) of a chart and a sign: the corners 1 and 2 are
    ``sign`` columns and ``sign`` rows away. Corners are recomputed on the way down, in the precision of the
    directions.
    """
    rectangles = icosahedron_rectangles(dtype=torch.float64)
    charts = rectangles[:, 1:, :-1].reshape(10, 3)
    base_vertices = torch.cat((rectangles[0, 0, :1], charts, rectangles[0, -1, -1:])).to(unit.device)
    base_corners = base_vertices[icosphere_faces(0, unit.device)].to(unit.dtype)

    # The faces of a regular icosahedron are the Voronoi cells of their centres.
    face = (unit @ F.normalize(base_corners.sum(1), dim=-1).T).argmax(-1)
    chart, half = face // 4, face % 2
    sign = 1 - 2 * half
    row, column = (face // 2) % 2 + half, half
    a, b, c = base_corners[face].unbind(1)
    for _ in range(level):
        ab, bc, ca = (F.normalize(p + q, dim=-1) for p, q in ((a, b), (b, c), (c, a)))
        to_ab, to_bc, to_ca = ab - unit, bc - unit, ca - unit
        at_a = _triple(unit, to_ab, to_ca) > 0
        at_b = (_triple(unit, to_bc, to_ab) > 0) & ~at_a  # exclusive also where rounding says otherwise
        at_c = (_triple(unit, to_ca, to_bc) > 0) & ~(at_a | at_b)
        inner = ~(at_a | at_b | at_c)
        row = 2 * row + sign * (at_c | inner)
        column = 2 * column + sign * (at_b | inner)
        sign = torch.where(inner, -sign, sign)
        at_a, at_b, at_c = at_a[:, None], at_b[:, None], at_c[:, None]
        a, b, c = (
            torch.where(at_a, a, torch.where(at_b, ab, torch.where(at_c, ca, bc))),
            torch.where(at_a, ab, torch.where(at_b, b, torch.where(at_c, bc, ca))),
            torch.where(at_a, ca, torch.where(at_b, bc, torch.where(at_c, c, ab))),
        )
    rows = torch.stack((row, row, row + sign), -1)
    columns = torch.stack((column, column + sign, column), -1)
    return vertex_at(chart[:, None], rows, columns, level), (a, b, c)
