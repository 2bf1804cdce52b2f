# SPDX-License-Identifier: Apache-2.0
"""Scanned points, such as those of a LiDAR, as depth along the rays of any grid or camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sphericalvision.cameras import Camera
from sphericalvision.core import ArgumentError
from sphericalvision.shapes import check_shapes
from sphericalvision.sphere.grids.sphere_grid import SphereGrid

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

NEIGHBOURS = 32
PART = 2**15
"""Pixels at once: each has numbers of all its neighbours, a dozen kilobytes."""
STEPS = 6
"""Of the fit of a surface, which leaves out more and more what lies on another one."""
ONE_SIDED = 0.45
"""Distance of the mean of the surface's points from a ray, in their mean distance from it; 0.6 at a straight edge."""


class PointTruth(NamedTuple):
    """Metres along the rays (0 where unknown), and where they are known; both of the shape of the grid or image."""

    depth: Float[Tensor, "*grid"]
    valid: Bool[Tensor, "*grid"]


@check_shapes
def truth_from_points(
    points: Float[Tensor, "P 3"],
    onto: SphereGrid | Camera,
    center: Float[Tensor, " 3"] | Sequence[float] | None = None,
    gap: float | None = None,
    tolerance: float = 0.017,
    noise: float = 0.0,
) -> PointTruth:
    """Depth along the rays of a grid or camera from the points of a scanner, which may stand elsewhere.

    Pixels through which no point is seen are unknown; nothing is filled in.

    The rule: of the points in a pixel that are within half a ``gap`` of its ray the nearest is taken. Through it and
    the points around, one for each quarter of a gap and the nearest again, the plane is laid that most of them agree
    with. The pixel is given the depth of that plane along its ray, unless

    * another point within a gap of the ray stands in front of the plane by more than ``tolerance``: the point may be
      hidden by a surface between whose points it shines through;
    * one within half a gap lies behind the plane by as much: the ray may pass the edge;
    * the points of the plane all lie to one side: the surface may end before the ray, at the sky or at the end of
      the scanner's view.

    What the scanner does not see, as it is outside of its view or has no echo, hides nothing: look at what such an
    object hides in the result.

    Args:
        points: ``(P, 3)`` metres, in the axes of the grid, or in the frame of the camera. NaN are left out.
        onto: any grid, or a camera.
        center: ``(3,)`` from which the grid looks, such as ``rig.center``; the origin when not given.
        gap: radians, about twice the angle between neighbouring lines of the scan as seen from the centre; measured
            when not given.
        tolerance: relative, of the distances to a plane.
        noise: standard deviation of the scanner's distances in metres; four times it is tolerated, too.

    Returns:
        ``depth`` and ``valid`` in the shape of the grid, or ``(h, w)``.

    Raises:
        ArgumentError: there is no point, or ``gap`` is not an angle.

    References:
        S. Katz, A. Tal, R. Basri, "Direct visibility of point sets", SIGGRAPH 2007, for the question.

    Examples:
        >>> from sphericalvision.icosphere import Icosphere
        >>> walls = 2.0 * Icosphere(5).vertices  # points all around, at 2 m
        >>> truth = truth_from_points(walls, Icosphere(3))
        >>> truth.valid.all().item(), truth.depth.mean().round(decimals=2).item()
        (True, 2.0)
    """
    from scipy.spatial import cKDTree  # half a second to import

    rays, distance = _seen_from(points, center)
    gap = _line_gap(rays) if gap is None else gap
    if not 0 < gap < math.pi / 2:
        raise ArgumentError(f"gap: expected an angle in radians in (0, π/2), got {gap!r}")
    middles, size = _rays_of(onto)
    pixels = _pixels_of(onto, rays)
    close = (middles[pixels.clamp(min=0)] - rays).norm(dim=-1) < gap / 2
    pixels = torch.where(close, pixels, -1)
    nearest = _nearest_of_each(pixels, distance)
    nearest = nearest[pixels[nearest] >= 0]
    depth, valid = distance.new_zeros(len(middles)), torch.zeros(len(middles), dtype=torch.bool)
    if len(nearest):
        pixel = pixels[nearest]
        thinned = _nearest_of_each(_cells(rays, gap / 4), distance)
        around = rays[thinned], distance[thinned]
        tree = cKDTree(around[0].numpy())
        for part, which in zip(nearest.split(PART), pixel.split(PART), strict=True):
            depth[which], valid[which] = _depth_of_planes(
                rays[part], distance[part], middles[which], tree, *around, gap, tolerance, noise
            )
    truth = depth.view(size).to(points), valid.view(size).to(points.device)
    return PointTruth(*truth)


def _seen_from(points: Tensor, center: Tensor | Sequence[float] | None) -> tuple[Tensor, Tensor]:
    """Unit rays and distances of the points that there are, in float64 on the CPU, where the search tree is."""
    rays = points.detach().cpu().double()
    if center is not None:
        rays = rays - torch.as_tensor(center).detach().cpu().double()
    distance = rays.norm(dim=-1)
    valid = distance.isfinite() & (distance > 1e-6)
    if not valid.any():
        raise ArgumentError(f"points: expected some that are finite and not at the centre, got {len(points)}")
    return rays[valid] / distance[valid, None], distance[valid]


def _rays_of(onto: SphereGrid | Camera) -> tuple[Tensor, tuple[int, ...]]:
    """The rays of all pixels ``(V, 3)``, and the shape of an image of them."""
    if isinstance(onto, Camera):
        directions = onto.unproject(onto.pixel_grid(torch.float64)).directions
        return directions.detach().cpu().reshape(-1, 3), onto.image_size
    return onto.directions.detach().cpu().double().reshape(-1, 3), tuple(onto.shape)


def _pixels_of(onto: SphereGrid | Camera, rays: Tensor) -> Int[Tensor, " P"]:
    """The pixel in which each ray is, -1 for none."""
    if not isinstance(onto, Camera):
        rays = rays.to(onto.directions.device)
        inside = onto.contains(rays) if hasattr(onto, "contains") else torch.ones_like(rays[:, 0]).bool()
        return torch.where(inside, onto.nearest(rays), -1).cpu()
    height, width = onto.image_size
    pixels, seen = onto.project(rays)
    columns, rows = pixels.round().nan_to_num().long().unbind(-1)
    return torch.where(seen, rows.clamp(0, height - 1) * width + columns.clamp(0, width - 1), -1).detach()


def _cells(rays: Tensor, width: float) -> Int[Tensor, " P"]:
    """A number for each ray that is shared by those in the same cube of a width."""
    cells = (rays / width).round().long() + round(2 / width)
    return (cells * torch.tensor([1 << 40, 1 << 20, 1])).sum(-1).unique(return_inverse=True)[1]


def _nearest_of_each(ids: Int[Tensor, " P"], distance: Tensor) -> Int[Tensor, " Q"]:
    """The number of the nearest point of each id."""
    order = distance.argsort(descending=True)
    last = torch.full((int(ids.max()) + 2,), -1)
    last[ids[order] + 1] = order  # later ones, which are nearer, replace earlier ones
    return last[last >= 0]


def _line_gap(rays: Tensor) -> float:
    """Twice the angle within which half of the rays have another one above, below, to the right and to the left."""
    from scipy.spatial import cKDTree  # half a second to import

    generator = torch.Generator().manual_seed(0)
    probes = rays[torch.randperm(len(rays), generator=generator)[:1000]]
    near, ids = cKDTree(rays.numpy()).query(probes.numpy(), k=min(64, len(rays)))
    angles, ids = (torch.from_numpy(part).reshape(len(probes), -1) for part in (near, ids))
    right, down = _frames(probes)
    offsets = rays[ids]
    bearing = torch.atan2((offsets * down[:, None]).sum(-1), (offsets * right[:, None]).sum(-1))
    side = (bearing / (math.pi / 2)).round().long() % 4
    firsts = [angles.where((side == k) & (angles > 1e-9), math.inf).amin(1) for k in range(4)]
    gap = 2 * float(torch.stack(firsts).amax(0).median())
    return gap if gap < 0.2 else 0.2  # so thin a scan gives no depth between its points


def _frames(rays: Tensor) -> tuple[Tensor, Tensor]:
    """Unit vectors to the right of each ray and, at right angles to both, down (at a pole any)."""
    down = torch.zeros_like(rays)
    down[:, 1] = 1
    down = torch.where(rays[:, 1:2].abs() > 0.999, down.roll(1, -1), down)
    right = F.normalize(torch.linalg.cross(down, rays), dim=-1)
    return right, torch.linalg.cross(rays, right)


class _Planes(NamedTuple):
    """Planes through points, one a pixel, as slopes of relative inverse depth over the offset from the point's ray.

    On the plane n · X = 1 inverse depth is n · d: linear in the direction d. Relative to the point (distance r along
    its ray e), and without what is the same for every plane, r / r' - e · d' is linear in the offset of d' from e.
    That leaves two unknowns, the slopes along the two axes of ``_frames``.
    """

    right: Tensor
    down: Tensor
    residual: Tensor
    """Of each neighbour ``(m, k)``, relative to the distance: above 0 in front of the plane."""
    weights: Tensor
    """How much each neighbour is of the plane ``(m, k)``."""


def _fit_planes(u: Tensor, v: Tensor, rise: Tensor, within: Tensor, blur: Tensor, gap: float) -> _Planes:
    """Planes that most neighbours agree with, by iteratively reweighted least squares.

    Args:
        u: offsets of neighbours to the right ``(m, k)``.
        v: downwards.
        rise: r / r' - e · d' of each.
        within: which neighbours there are.
        blur: noise of the point's distance ``(m, 1)``, relative.
        gap: radians.
    """
    # Cauchy's weights: wide at first (5 %), so that a start among two surfaces can go to either, then narrow (1 %).
    weights, residual = within / (1 + (rise / 0.05).square()), rise
    right = down = torch.zeros_like(rise[:, 0])
    # A single line of points determines one slope; damping makes the other 0.
    damping = 1e-4 * gap**2
    for _ in range(STEPS):
        # Normal equations of two unknowns, solved by Cramer's rule for all pixels at once.
        uu = (weights * u * u).sum(1) + damping
        vv = (weights * v * v).sum(1) + damping
        uv, ur, vr = (weights * u * v).sum(1), (weights * u * rise).sum(1), (weights * v * rise).sum(1)
        determinant = uu * vv - uv * uv
        right, down = (vv * ur - uv * vr) / determinant, (uu * vr - uv * ur) / determinant
        residual = rise - right[:, None] * u - down[:, None] * v
        weights = within / (1 + (residual / (0.01 + blur)).square())
    return _Planes(right, down, residual, weights)


def _depth_of_planes(
    rays: Tensor,
    distance: Tensor,
    middles: Tensor,
    tree: cKDTree,
    around: Tensor,
    far: Tensor,
    gap: float,
    tolerance: float,
    noise: float,
) -> tuple[Tensor, Tensor]:
    """Depth along the rays of pixels of the planes around points, and where the rule lets it stand.

    Args:
        rays: ``(m, 3)`` of the points, one for each pixel.
        distance: ``(m,)`` of the points.
        middles: ``(m, 3)``, rays of the pixels.
        tree: of ``around``.
        around: ``(n, 3)``, rays of all points that may be neighbours.
        far: ``(n,)``, their distances.
        gap: as of ``truth_from_points``; so are tolerance and noise.
    """
    angles, ids = tree.query(middles.numpy(), k=min(NEIGHBOURS, len(around)), distance_upper_bound=gap)
    angles, ids = (torch.from_numpy(array).reshape(len(rays), -1) for array in (angles, ids))
    within = angles.isfinite()
    ids, angles = ids.where(within, 0), angles.where(within, 0.0)
    neighbors = around[ids]
    rise = distance[:, None] / far[ids] - (neighbors * rays[:, None]).sum(-1)
    frame = _frames(rays)
    u, v = ((neighbors * axis[:, None]).sum(-1) for axis in frame)
    blur = noise / distance[:, None]
    plane = _fit_planes(u, v, rise, within, blur, gap)
    limit = tolerance + 4 * blur
    in_front = (within & (plane.residual > limit)).any(1)
    behind = (within & (angles < gap / 2) & (plane.residual < -limit)).any(1)
    # The plane's points lie to one side if their mean is far from the ray, measured by their own spread.
    mean = ((neighbors - middles[:, None]) * plane.weights[..., None]).sum(1).norm(dim=-1)
    spread = ((plane.weights * angles.square()).sum(1) * plane.weights.sum(1)).sqrt()
    tilted = rays + plane.right[:, None] * frame[0] + plane.down[:, None] * frame[1]
    # Depth of the point over that along the pixel's ray, which changes too fast where a plane is seen at a small angle.
    ratio = (middles * tilted).sum(-1)
    is_steady = (ratio > 0.8) & (ratio < 1.25)
    valid = ~in_front & ~behind & (mean <= ONE_SIDED * spread) & is_steady
    return torch.where(valid, distance / ratio.clamp(min=0.1), 0.0), valid
