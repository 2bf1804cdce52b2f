# SPDX-License-Identifier: Apache-2.0
"""Surface points of a depth estimate: coloured, with normals, and without the points that hang between near and far."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.icosphere import Icosphere
from sphericalvision.sphere import SphereGrid
from sphericalvision.viz.pointcloud import point_colors

__all__ = [
    "SurfacePoints",
    "distance_along",
    "grid_faces",
    "hangs_between",
    "surface_normals",
    "surface_points",
    "voxel_means",
]

STEEPEST = math.radians(84)
"""Between a ray and the normal of the surface it meets; a floor is as steep ten heights away."""
STEPS, HALVINGS = 64, 12
AT_ONCE = 2**19
"""Points that are looked up together: an icosphere locates many faster than few."""
FARTHEST = 1e4
"""Nearest depths: beyond, a camera of the rig sees what its centre sees."""


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


def grid_faces(grid: SphereGrid) -> Int[Tensor, "F 3"]:
    """Return triangles between neighbouring points of a grid, as ids into the flattened grid.

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
    upper = torch.stack((ids[:-1, :-1], ids[1:, :-1], ids[:-1, 1:]), -1)
    lower = torch.stack((ids[:-1, 1:], ids[1:, :-1], ids[1:, 1:]), -1)
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

    def mean(values: Tensor) -> Tensor:
        columns = values.reshape(len(values), -1)
        total = columns.new_zeros(len(counts), columns.shape[1]).index_add_(0, ids, columns)
        return (total / counts[:, None]).reshape(len(counts), *values.shape[1:])

    return SurfacePoints(
        mean(cloud.points),
        mean(cloud.colors),
        F.normalize(mean(cloud.normals), dim=-1),
        mean(cloud.confidence),
    )


def distance_along(
    rays: Float[Tensor, "n 3"],
    start: Float[Tensor, " 3"],
    inverse_depth: Callable[[Tensor], Tensor],
    min_depth: float,
) -> Float[Tensor, " n"]:
    """Return the distance ``(n,)`` at which each ray first passes the surface; NaN where it never does.

    A point p is behind the surface where |p| · w(p / |p|) > 1. A ray is followed in even steps of inverse distance, the
    spacing of hypotheses, until a point is behind; the place is then halved in. Where nothing is known a ray goes on,
    and meets nothing before it is in front again.

    Args:
        rays: ``(n, 3)`` unit directions.
        start: ``(3,)`` of all rays, from the point that depth is measured around, metres.
        inverse_depth: of the surface, 1/m, ``(n,)`` in unit directions ``(n, 3)``; NaN where nothing is known.
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
        share = 1 - norm * inverse_depth(points / norm.clamp(min=1e-9)[:, None])
        return share.view(distances.shape)

    nearest = max(min_depth - float(start.norm()), 0.05 * min_depth)
    steps = 1 / torch.linspace(1 / nearest, 1 / (FARTHEST * min_depth), STEPS, dtype=torch.float64)
    steps = torch.cat((steps.new_zeros(1), steps)).to(rays)
    waiting = torch.arange(len(rays), device=rays.device)
    in_front = torch.ones_like(
        waiting, dtype=torch.bool
    )  # rays of a rig's camera begin before the nearest surface
    low, high = rays.new_full((2, len(rays)), math.nan)
    first = 1
    while first < len(steps) and len(waiting):
        last = min(first + max(1, AT_ONCE // len(waiting)), len(steps))
        ahead = front_of(steps[first:last, None].expand(-1, len(waiting)), waiting)
        was = torch.cat((in_front[None], ahead[:-1] > 0))
        met = was & (ahead <= 0)
        which, hit = met.int().argmax(0) + first, met.any(0)
        low[waiting[hit]], high[waiting[hit]] = steps[which[hit] - 1], steps[which[hit]]
        waiting, in_front, first = waiting[~hit], (ahead[-1] > 0)[~hit], last
    hits = high.isfinite().nonzero()[:, 0]
    near, far = low[hits], high[hits]
    for _ in range(HALVINGS):
        middle = _between(near, far)
        front = front_of(middle, hits) > 0
        near, far = torch.where(front, middle, near), torch.where(front, far, middle)
    distance = rays.new_full((len(rays),), math.nan)
    distance[hits] = _between(near, far)
    return distance


def _between(near: Tensor, far: Tensor) -> Tensor:
    """The middle in inverse distance, as the steps are spaced; the first step begins at zero, where there is none."""
    return torch.where(near > 0, 2 / (1 / near.clamp(min=1e-9) + 1 / far), far / 2)
