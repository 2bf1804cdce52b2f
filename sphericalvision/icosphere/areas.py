# SPDX-License-Identifier: Apache-2.0
"""Solid angles of faces and vertices, and normals of surfaces spread over an icosphere."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sphericalvision.core import check_last_dim
from sphericalvision.icosphere.mesh import icosphere_vertices
from sphericalvision.icosphere.topology import (
    icosphere_faces,
    level_from_num_vertices,
    num_icosphere_vertices,
)


def icosphere_face_solid_angles(
    level: int, dtype: torch.dtype | None = None, device: torch.device | str | None = None
) -> Float[Tensor, " F"]:
    """Return the solid angle of every spherical triangle in steradians, ``(F,)``.

    References:
        van Oosterom and Strackee (1983), "The solid angle of a plane triangle".

    Examples:
        >>> icosphere_face_solid_angles(0)[0] * 20 / torch.pi
        tensor(4.)
    """
    corners = icosphere_vertices(level, torch.float64, device)[icosphere_faces(level, device)]
    return _triangle_solid_angles(*corners.unbind(1)).to(dtype or torch.get_default_dtype())


def icosphere_solid_angles(
    level: int, dtype: torch.dtype | None = None, device: torch.device | str | None = None
) -> Float[Tensor, " V"]:
    """Return the solid angle of every vertex in steradians, ``(V,)``: a third of each spherical triangle
    around it.

    These are the weights that integrate functions which are linear in each triangle, the ones
    ``Icosphere.sample`` makes.

    Examples:
        >>> round(icosphere_solid_angles(3).sum().item() / torch.pi, 6)
        4.0
    """
    faces = icosphere_faces(level, device)
    thirds = icosphere_face_solid_angles(level, torch.float64, device) / 3
    total = thirds.new_zeros(num_icosphere_vertices(level))
    total.index_add_(0, faces.flatten(), thirds.repeat_interleave(3))
    return total.to(dtype or torch.get_default_dtype())


def icosphere_voronoi_solid_angles(
    level: int, dtype: torch.dtype | None = None, device: torch.device | str | None = None
) -> Float[Tensor, " V"]:
    """Return the solid angle of every vertex's Voronoi cell in steradians, ``(V,)``.

    The cell holds the directions that are nearer to this vertex than to any other one, those for which
    ``Icosphere.nearest`` gives it: the weights that integrate values which are constant in each cell.

    Examples:
        >>> round(icosphere_voronoi_solid_angles(3).sum().item() / torch.pi, 6)
        4.0
    """
    faces = icosphere_faces(level, device)
    corners = icosphere_vertices(level, torch.float64, device)[faces]
    a, b, c = corners.unbind(1)
    center = F.normalize(torch.linalg.cross(b - a, c - a), dim=-1)[:, None].expand_as(corners)
    # Middles of the edges from each corner to the next
    after = F.normalize(corners + corners.roll(-1, 1), dim=-1)
    before = after.roll(1, 1)
    # From each corner to the middle of an edge, the circumcentre, and the middle of the other edge.
    areas = _triangle_solid_angles(corners, after, center) + _triangle_solid_angles(corners, center, before)
    total = areas.new_zeros(num_icosphere_vertices(level))
    total.index_add_(0, faces.flatten(), areas.flatten())
    return total.to(dtype or torch.get_default_dtype())


def icosphere_normals(points: Float[Tensor, "*batch V 3"]) -> Float[Tensor, "*batch V 3"]:
    """Return the normals of a surface through points at the vertices of an icosphere.

    The normal at a vertex is the mean of those of the triangles around it, weighted by their area; it points
    outwards, away from the centre, where the surface is seen from there. For depth d the points are
    ``d[..., None] * ico.vertices``.

    Args:
        points: ``(*, V, 3)``.

    Returns:
        ``(*, V, 3)`` unit vectors, differentiable in the points. Triangles with a corner that is not finite are left
        out; where none is left the normal is zero.

    Examples:
        >>> from sphericalvision.icosphere import Icosphere
        >>> ico = Icosphere(2)
        >>> bool((icosphere_normals(3 * ico.vertices) * ico.vertices).sum(-1).min() > 0.999)
        True
    """
    check_last_dim("points", points, 3)
    faces = icosphere_faces(level_from_num_vertices(points.shape[-2]), points.device)
    finite = points.isfinite().all(-1)
    valid = finite[..., faces].all(-1)
    a, b, c = torch.where(finite[..., None], points, 0.0)[..., faces, :].unbind(-2)
    face_normals = torch.linalg.cross(b - a, c - a)  # as long as twice the area
    face_normals = torch.where(valid[..., None], face_normals, 0.0)
    total = torch.zeros_like(points)
    for corner in faces.unbind(1):
        total = total.index_add(-2, corner, face_normals)
    return F.normalize(total, dim=-1)


def _triangle_solid_angles(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Return the signed solid angles ``(*)`` of triangles of unit vectors ``(*, 3)``."""
    volume = (a * torch.linalg.cross(b - a, c - a)).sum(-1)
    return 2 * torch.atan2(volume, 1 + (a * b).sum(-1) + (b * c).sum(-1) + (c * a).sum(-1))
