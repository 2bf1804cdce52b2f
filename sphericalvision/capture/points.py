# SPDX-License-Identifier: Apache-2.0
"""Surface points of a depth estimate: coloured, with normals, and without the points that hang between near and far."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.icosphere import Icosphere
from sphericalvision.sphere import SphereGrid
from sphericalvision.viz.mesh import surface_mesh
from sphericalvision.viz.pointcloud import point_colors

if TYPE_CHECKING:
    import trimesh

STEEPEST = math.radians(84)
"""Between a ray and the normal of the surface it meets; a floor is as steep ten heights away."""
CORNERS = 8
"""Cubes that meet at a point: of larger ones a cloud around it has no more."""


class SurfacePoints(NamedTuple):
    """Points in the world.

    Attributes:
        points: ``(n, 3)`` metres.
        colors: ``(n, 3)`` in [0, 1].
        normals: ``(n, 3)`` unit length, towards the rig.
        confidence: ``(n,)`` 0 to 1.
    """

    points: Float[Tensor, "n 3"]
    colors: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    confidence: Float[Tensor, " n"]


def surface_points(
    grid: SphereGrid,
    inverse_depth: Float[Tensor, " V"],
    confidence: Float[Tensor, " V"],
    mask: Bool[Tensor, " V"],
    rig: CameraRig,
    images: Mapping[str, Float[Tensor, "3 _ _"]],
) -> SurfacePoints:
    """Return the points of a surface around a rig of a mask, that do not hang in the air, and that have a colour.

    Args:
        grid: of V directions.
        inverse_depth: 1/m, from the rig's centre.
        confidence: 0 to 1.
        mask: True for points that count.
        rig: unbatched, on the device of the others.
        images: camera name -> ``(3, h, w)`` in [0, 1].

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> rig, ones = ring_rig(3, image_size=(8, 8)), torch.ones(162)
        >>> images = {name: torch.rand(3, 8, 8) for name in rig.names}
        >>> cloud = surface_points(Icosphere(2), 0.5 * ones, ones, ones > 0, rig, images)
        >>> cloud.points.shape == cloud.normals.shape, cloud.points.norm(dim=-1).mean()
        (True, tensor(2.))
    """
    rays, faces = grid.directions.reshape(-1, 3).float(), grid_faces(grid)
    relative = rays / inverse_depth.clamp(min=1e-6)[:, None]
    normals = surface_normals(relative, faces)
    mask = mask & ~hangs_between(inverse_depth, rays, faces)
    points = relative[mask] + rig.center.to(relative)
    colors, seen = point_colors(rig, images, points)
    return SurfacePoints(points[seen], colors.T[seen], normals[mask][seen], confidence[mask][seen])


def grid_mesh(
    grid: SphereGrid,
    inverse_depth: Float[Tensor, " V"],
    mask: Bool[Tensor, " V"],
    rig: CameraRig,
    images: Mapping[str, Float[Tensor, "3 _ _"]],
) -> trimesh.Trimesh:
    """Return the surface of ``surface_points`` as triangles between neighbours, none steeper than a surface may be.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> rig, ones = ring_rig(3, image_size=(8, 8)), torch.ones(162)
        >>> images = {name: torch.rand(3, 8, 8) for name in rig.names}
        >>> grid_mesh(Icosphere(2), 0.5 * ones, ones > 0, rig, images).is_watertight
        True
    """
    rays, faces = grid.directions.reshape(-1, 3).float(), grid_faces(grid)
    depth = inverse_depth.clamp(min=1e-6).reciprocal()
    colors, seen = point_colors(rig, images, rays * depth[:, None] + rig.center.to(rays))
    widest = (rays[faces] - rays[faces.roll(1, -1)]).norm(dim=-1).amax()
    jump = math.exp(math.tan(STEEPEST) * float(widest))
    mesh = surface_mesh(rays, faces, depth.where(mask & seen, math.nan), colors, jump)
    return mesh.apply_translation(rig.center.cpu().double().numpy())


def grid_faces(grid: SphereGrid) -> Int[Tensor, "F 3"]:
    """Return triangles between neighbouring points of a grid, as ids into the flattened grid, that turn outwards.

    Examples:
        >>> from sphericalvision.sphere import Equirectangular
        >>> grid_faces(Icosphere(1)).shape, grid_faces(Equirectangular(3, 6)).shape
        (torch.Size([80, 3]), torch.Size([24, 3]))
    """
    if isinstance(grid, Icosphere):
        return grid.faces
    height, width = grid.shape
    ids = torch.arange(height * width, device=grid.directions.device).view(height, width)
    ids = torch.cat((ids, ids[:, :1]), 1)  # left and right edges meet
    upper = torch.stack((ids[:-1, :-1], ids[:-1, 1:], ids[1:, :-1]), -1)
    lower = torch.stack((ids[:-1, 1:], ids[1:, 1:], ids[1:, :-1]), -1)
    return torch.cat((upper.reshape(-1, 3), lower.reshape(-1, 3)))


def hangs_between(
    inverse_depth: Float[Tensor, " V"], rays: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> Bool[Tensor, " V"]:
    """Return which points have something much nearer on one side and something much farther on the other.

    An estimate that is smooth across an edge of depth has such points in between; they are streamers in the air that
    nothing in the world corresponds to. *Much* is more than the steepest surface would rise over the same angle.

    Examples:
        >>> from sphericalvision.icosphere import Icosphere
        >>> grid = Icosphere(5)
        >>> side = (grid.vertices[:, 0] / 0.04).clamp(-1, 1)  # near to the right, far to the left, a ramp in between
        >>> hanging = hangs_between(0.55 + 0.45 * side, grid.vertices, grid.faces)
        >>> bool(hanging.any()), bool(hanging[side.abs() == 1].any())
        (True, False)
    """
    edges = torch.cat((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]))
    edges = torch.cat((edges, edges.flip(1)))
    here, other = edges.unbind(1)
    # Of a plane whose normal is at an angle a from the ray, log depth rises by tan(a) times the angle between rays.
    rise = inverse_depth.clamp(min=1e-6).log().neg()
    slope = (rise[other] - rise[here]) / (rays[other] - rays[here]).norm(dim=-1).clamp(min=1e-6)
    steepest = math.tan(STEEPEST)
    farther, nearer = (rise.new_zeros(len(rays), dtype=torch.bool) for _ in range(2))
    farther[here[slope > steepest]] = True
    nearer[here[slope < -steepest]] = True
    return farther & nearer


def surface_normals(points: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "V 3"]:
    """Return unit normals ``(V, 3)`` of a surface around the origin, towards the origin.

    Triangles count by how squarely they face the origin, so that those across an edge of depth hardly do.

    Examples:
        >>> from sphericalvision.icosphere import Icosphere
        >>> grid = Icosphere(3)
        >>> bool(((surface_normals(2 * grid.vertices, grid.faces) + grid.vertices).norm(dim=-1) < 0.03).all())
        True
    """
    a, b, c = points[faces].unbind(1)
    normals = F.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    facing = (normals * F.normalize(a + b + c, dim=-1)).sum(-1, keepdim=True)
    weighted = -normals * facing  # its sign turns all of them inwards
    total = torch.zeros_like(points)
    for corner in range(3):
        total.index_add_(0, faces[:, corner], weighted)
    inwards = -F.normalize(points, dim=-1)
    return torch.where(total.norm(dim=-1, keepdim=True) > 1e-9, F.normalize(total, dim=-1), inwards)


def voxel_means(cloud: SurfacePoints, side: float) -> SurfacePoints:
    """Return one point, the mean, for each cube of a side in metres that holds points.

    Examples:
        >>> points = torch.tensor([[0.1, 0.1, 0.1], [0.3, 0.1, 0.1], [1.5, 0.0, 0.0]])
        >>> cloud = SurfacePoints(points, points, torch.eye(3), torch.ones(3))
        >>> voxel_means(cloud, 1.0).points
        tensor([[0.2000, 0.1000, 0.1000],
                [1.5000, 0.0000, 0.0000]])
    """
    cubes = (cloud.points / side).floor().long()
    _, ids, counts = cubes.unique(dim=0, return_inverse=True, return_counts=True)
    if len(counts) <= CORNERS < len(cloud.points):
        warnings.warn(
            f"voxel: all points are in {CORNERS} cubes or fewer of {side:g} m; are these metres?",
            stacklevel=3,
        )

    def mean(values: Tensor) -> Tensor:
        columns = values.reshape(len(values), -1)
        total = columns.new_zeros(len(counts), columns.shape[1]).index_add_(0, ids, columns)
        return (total / counts[:, None]).reshape(len(counts), *values.shape[1:])

    means = SurfacePoints(*map(mean, cloud))
    return means._replace(normals=F.normalize(means.normals, dim=-1))
