# SPDX-License-Identifier: Apache-2.0
"""Tables of a sphere sweep: the points of concentric icospheres on the icosphere of every camera."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.core import check_type
from sphericalvision.geometry.lookup import read_entries
from sphericalvision.icosphere import TriangleLocator
from sphericalvision.kernels import Operator


class SweepTables(NamedTuple):
    """Tables of a rig: the triangle on the camera's icosphere of every (hypothesis, vertex, camera).

    A rig that is shared by the batch has tables without a batch dimension. An entry is one point location, so tables of
    a fixed rig are made once and passed in its place. Cameras come last: the values of all cameras at a point are then
    contiguous, as for channels-last convolutions.

    Attributes:
        ids: ``([B,] N, V, n, 3)`` vertex ids on a camera's icosphere.
        weights: ``([B,] N, V, n, 3)`` barycentric weights, zero outside the field of view.
        seen: ``([B,] N, V, n)`` True inside the field of view.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.sweep import SphereSweep
        >>> tables = SphereSweep(level=2, num_hypotheses=4, min_depth=0.5).tables(ring_rig(2))
        >>> tables.ids.shape
        torch.Size([4, 162, 2, 3])
    """

    ids: Int[Tensor, "*batch N V n 3"]
    weights: Float[Tensor, "*batch N V n 3"]
    seen: Bool[Tensor, "*batch N V n"]

    @property
    def num_cameras(self) -> int:
        """n, the number of cameras."""
        return self.ids.shape[-2]

    def to(self, device: torch.device | str) -> SweepTables:
        """Return the tables on another device."""
        return SweepTables(*(table.to(device) for table in self))

    def permuted(self, order: Int[Tensor, " n"]) -> SweepTables:
        """Return the tables with the cameras in another order, given as a permutation ``(n,)``."""
        ids, weights, seen = self
        return SweepTables(ids[..., order, :], weights[..., order, :], seen[..., order])


def sweep_tables(
    directions: Float[Tensor, "V 3"],
    inverse_depths: Float[Tensor, " N"],
    rig: CameraRig,
    feature_level: int,
) -> SweepTables:
    """Locate the points of a sphere sweep on the icosphere of every camera.

    The point of direction d at inverse depth w is ``rig.center + d / w``. A camera at c sees it in the direction
    ``d + w * (rig.center - c)``, which is exact up to infinity (w = 0); its icosphere is aligned with the world. A
    point counts as seen within the camera's ``max_angle`` of its optical axis; occlusion is not known.

    Args:
        directions: ``(V, 3)`` unit vectors in the world frame; their device is the device of the tables.
        inverse_depths: ``(N,)`` in 1/m.
        rig: of n cameras; poses ``(n, 4, 4)`` for all of a batch or ``(B, n, 4, 4)`` for a rig a sample.
        feature_level: level of the icosphere that the cameras' values are on.

    Returns:
        Tables of N hypotheses, V directions and n cameras, in the dtype of the rig and differentiable in its
        poses.

    References:
        Komatsu et al. (2020), "360° depth estimation from multiple fisheye images with origami crown
        representation of icosahedron", section III-C.
    """
    check_type("rig", rig, CameraRig, "ring_rig makes one, read_rig reads one")
    poses = rig.world_from_camera.to(directions.device)
    center, axes, max_angles = (
        torch.as_tensor(values).to(poses) for values in (rig.center, rig.axes, rig.max_angles)
    )
    offsets = center[..., None, :] - poses[..., :3, 3]
    axes, limits = axes.detach(), _limits(max_angles.detach())
    locator = TriangleLocator(feature_level, poses.dtype, poses.device)
    batch = poses.shape[:-3]
    # Entries do not depend on other cameras: those of all rigs are located as if they were of one.
    points = _points(
        directions.to(poses),
        inverse_depths.to(poses),
        offsets.reshape(-1, 3),
        axes.reshape(-1, 3),
        limits.reshape(-1),
    )
    if points.directions.is_meta:  # without values nothing is known to be in view
        tables = _empty_tables(points)
    elif torch.is_grad_enabled() and any(x.requires_grad for x in points):
        tables, triangles = _locate_seen(points, locator)
        tables = tables._replace(weights=_differentiable_weights(points, tables.seen, triangles, locator))
    else:
        tables, _ = _locate(points, locator)
    return SweepTables(*(_by_rig(table, batch) for table in tables)) if batch else tables


def _by_rig(table: Tensor, batch: torch.Size) -> Tensor:
    """``(*batch, N, V, n, *)`` of a table ``(N, V, *batch * n, *)``."""
    count = len(batch)
    return table.unflatten(2, (*batch, -1)).movedim((0, 1), (count, count + 1)).contiguous()


class _Points(NamedTuple):
    """Points of a sweep relative to n cameras.

    Coordinates come first, so that arithmetic runs over contiguous memory. They are written out for every vertex and
    camera, as broadcasting so short a dimension is slow.
    """

    directions: Tensor  # (3, V, n)
    inverse_depths: Tensor  # (N, 1, 1)
    offsets: Tensor  # (3, V, n)
    axes: Tensor  # (3, V, n)
    limits: Tensor  # (V, n)

    def rays(self, hypotheses: slice, vertices: slice) -> Tensor:
        """Rays ``(3, h, v, n)`` from the cameras to a block of the points."""
        offset = self.inverse_depths[hypotheses] * self.offsets[:, None, vertices]
        return self.directions[:, None, vertices] + offset

    def blocks(self, size: int) -> Iterator[tuple[slice, slice]]:
        """Blocks of about ``size`` entries, as slices of hypotheses and vertices.

        A block is all vertices of some hypotheses or some vertices of one: a contiguous view of a table, into which
        results are written, and small enough for the processor's cache.
        """
        num_vertices, num_cameras = self.limits.shape
        hypotheses = max(1, size // (num_vertices * num_cameras))
        vertices = num_vertices if hypotheses > 1 else max(1, min(num_vertices, size // num_cameras))
        for hypothesis in range(0, len(self.inverse_depths), hypotheses):
            for vertex in range(0, num_vertices, vertices):
                yield slice(hypothesis, hypothesis + hypotheses), slice(vertex, vertex + vertices)


def _points(
    directions: Tensor, inverse_depths: Tensor, offsets: Tensor, axes: Tensor, limits: Tensor
) -> _Points:
    """Write directions ``(V, 3)`` and offsets, axes ``(n, 3)`` and limits ``(n,)`` of n cameras out for all pairs."""
    shape = len(directions), len(offsets)
    directions, offsets, axes = (
        vectors.expand(3, *shape).contiguous()
        for vectors in (directions.T[:, :, None], offsets.T[:, None], axes.T[:, None])
    )
    return _Points(
        directions, inverse_depths[:, None, None], offsets, axes, limits.expand(shape).contiguous()
    )


def _empty_tables(points: _Points) -> SweepTables:
    shape = len(points.inverse_depths), *points.limits.shape
    return SweepTables(
        points.limits.new_empty((*shape, 3), dtype=torch.long),
        points.limits.new_zeros(*shape, 3),
        points.limits.new_empty(shape, dtype=torch.bool),
    )


@torch.no_grad()
def _locate_seen(points: _Points, locator: TriangleLocator) -> tuple[SweepTables, Tensor]:
    """Locate the points in view alone, and return their triangles, too: weights of others are zero, and without NaN."""
    tables, triangles = _empty_tables(points), []
    corners = F.pad(locator.faces, (0, 0, 1, 0))  # the first row is for what is not in view
    for rays, ids, weights, seen in _blocks_in_view(points, tables, locator.chunk_size):
        in_view = seen.flatten().nonzero()[:, 0]
        found, shares = locator.find(read_entries(rays.flatten(1), in_view))
        rows = found.new_zeros(seen.numel()).index_copy_(0, in_view, found + 1)
        torch.index_select(corners, 0, rows, out=ids.view(-1, 3))
        weights.view(-1, 3).index_copy_(0, in_view, shares.T)
        triangles.append(found)
    return tables, torch.cat(triangles)


@torch.no_grad()
def _locate_all(points: _Points, locator: TriangleLocator) -> tuple[SweepTables, Tensor]:
    """Locate all points and mask those out of view, so that no device is asked how many there are."""
    tables, triangles = _empty_tables(points), []
    corners = F.pad(locator.faces, (0, 0, 1, 0))
    for rays, ids, weights, seen in _blocks_in_view(points, tables, locator.chunk_size):
        found, shares = locator.find(rays.flatten(1))
        in_view = seen.flatten()
        torch.index_select(corners, 0, (found + 1) * in_view, out=ids.view(-1, 3))
        weights[...] = shares.T.where(in_view[:, None], 0.0).view_as(weights)
        triangles.append(found)
    return tables, torch.cat(triangles)


_locate = Operator(_locate_seen, fused=_locate_all)


def _differentiable_weights(
    points: _Points, seen: Tensor, triangles: Tensor, locator: TriangleLocator
) -> Tensor:
    """Weights ``(N, V, n, 3)`` of the triangles in view, differentiable in rays."""
    in_view = seen.flatten().nonzero()[:, 0]
    rays = points.rays(slice(None), slice(None)).flatten(1).index_select(1, in_view)
    weights = locator.weights(rays, triangles)
    return weights.new_zeros(seen.numel(), 3).index_copy(0, in_view, weights.T).view(*seen.shape, 3)


def _limits(max_angles: Tensor) -> Tensor:
    """Least cosines of angles in view, less rounding; all directions are in view from π on.

    A cosine is cheaper than the angle. Rounding moves the limit by some eps / sin(max_angle): at most 1e-5 rad in
    float32 between 1 and 179 degrees.
    """
    limits = max_angles.cos() - 4 * torch.finfo(max_angles.dtype).eps
    return torch.where(max_angles >= math.pi, -2.0, limits)


def _blocks_in_view(
    points: _Points, tables: SweepTables, size: int
) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Rays ``(3, h, v, n)`` of each block of points, and its part of the tables.

    ``seen`` is written before: which rays are in view; one of zero length never is.
    """
    for block in points.blocks(size):
        ids, weights, seen = (table[block] for table in tables)
        rays, axes, limits = points.rays(*block), points.axes[:, block[1]], points.limits[block[1]]
        x, y, z = rays
        length = (x * x).addcmul_(y, y).addcmul_(z, z).sqrt_()
        along = (axes[0] * x).addcmul_(axes[1], y).addcmul_(axes[2], z)
        torch.gt(along, length.mul_(limits), out=seen)
        yield rays, ids, weights, seen
