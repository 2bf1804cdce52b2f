# SPDX-License-Identifier: Apache-2.0
"""Sphere sweep: what each camera sees at the points of concentric icospheres around the rig."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from sphericalvision.core import ShapeError
from sphericalvision.icosphere import icosphere_vertices, locate, num_icosphere_vertices
from sphericalvision.sweep.hypotheses import check_hypotheses, inverse_depth_hypotheses

if TYPE_CHECKING:
    from sphericalvision.cameras import CameraRig

__all__ = ["SphereSweep", "SweepTables", "SweepVolume", "sphere_sweep", "sweep_tables"]


class SweepVolume(NamedTuple):
    """Values ``(B, n, C, N, V)`` of n cameras at N hypotheses, zero where ``mask`` is False.

    The mask ``(B, n, N, V)`` is True where the point is inside the camera's field of view; for a rig that is
    shared by the batch it is an expanded view.
    """

    values: Tensor
    mask: Tensor


class SweepTables(NamedTuple):
    """Where to look up every (hypothesis, vertex, camera) on the cameras' icospheres: a rig, made ready.

    Tables of a rig that is shared by the batch have no batch dimension. They cost one point location for
    every entry, so a caller with a fixed rig makes them once and passes them in place of the rig. Cameras
    come last, because then the values of all cameras at one point lie side by side in memory, as
    channels-last convolutions want them.

    Attributes:
        ids: ``([B,] N, V, n, 3)`` vertex ids on a camera's icosphere.
        weights: ``([B,] N, V, n, 3)`` barycentric weights, zero outside the field of view.
        mask: ``([B,] N, V, n)`` True inside the field of view.
    """

    ids: Tensor
    weights: Tensor
    mask: Tensor

    @property
    def num_cameras(self) -> int:
        """n, the number of cameras."""
        return self.ids.shape[-2]

    def to(self, device: torch.device | str) -> SweepTables:
        """Return the tables on another device."""
        return SweepTables(*(table.to(device) for table in self))

    def permuted(self, order: Tensor) -> SweepTables:
        """Return the tables with the cameras in another order, given as a permutation ``(n,)``."""
        ids, weights, mask = self
        return SweepTables(ids[..., order, :], weights[..., order, :], mask[..., order])


def sweep_tables(
    directions: Tensor, inverse_depths: Tensor, rig: CameraRig, feature_level: int
) -> SweepTables:
    """Locate the points of a sphere sweep on the icosphere of every camera.

    The point of direction d at inverse depth w is ``rig.center + d / w``. A camera at c sees it in the
    direction of ``d + w * (rig.center - c)``, which stays exact up to infinity (w = 0); camera icospheres are
    aligned with the world. A point counts as seen if that direction is within the camera's ``max_angle`` of
    its optical axis; occlusion is not known.

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
    poses = rig.world_from_camera.to(directions.device)
    center, axes, max_angles = (
        torch.as_tensor(values).to(poses) for values in (rig.center, rig.axes, rig.max_angles)
    )
    offsets = center[..., None, :] - poses[..., :3, 3]
    # A hypothesis at a time stays in the cache; coordinates come first, so that memory is contiguous.
    points = directions.to(poses).T[:, :, None]
    axes, offsets = (vectors.movedim(-1, 0).unsqueeze(-2) for vectors in (axes, offsets))
    columns = []
    for inverse_depth in inverse_depths.to(poses):
        rays = points.view(3, *[1] * (offsets.ndim - 3), *points.shape[1:]) + inverse_depth * offsets
        columns.append(_locate_seen(rays, axes, max_angles[..., None, :], feature_level))
    return SweepTables(*(torch.stack(tables, poses.ndim - 3) for tables in zip(*columns, strict=True)))


def _locate_seen(rays: Tensor, axes: Tensor, max_angles: Tensor, level: int) -> tuple[Tensor, Tensor, Tensor]:
    """Ids, weights ``(*b, V, n, 3)`` and mask ``(*b, V, n)`` of rays ``(3, *b, V, n)`` of any length."""
    with torch.no_grad():
        x, y, z = rays
        p, q, r = axes
        across = (q * z - r * y).square() + (r * x - p * z).square() + (p * y - q * x).square()
        along = p * x + q * y + r * z
        mask = (torch.atan2(across.sqrt(), along) <= max_angles) & (rays != 0).any(0)
    seen = mask.flatten().nonzero()[:, 0]
    # Only points in view are located: the weights of others are zero, and no NaN may reach a gradient.
    found, shares = locate(rays.flatten(1).index_select(1, seen).T, level)
    ids = found.new_zeros(mask.numel(), 3).index_copy_(0, seen, found)
    weights = shares.new_zeros(mask.numel(), 3).index_copy(0, seen, shares)
    return ids.view(*mask.shape, 3), weights.view(*mask.shape, 3), mask


def sphere_sweep(features: Tensor, tables: SweepTables) -> SweepVolume:
    """Look up the values of every camera at every hypothesis.

    Args:
        features: ``(B, n, C, V_f)`` values on the cameras' icospheres.
        tables: of n cameras, for all of the batch or with a batch dimension B.

    Returns:
        Values ``(B, n, C, N, V)``, zero out of view, and the mask. In memory cameras and channels are
        innermost.

    Raises:
        ShapeError: if features and tables do not fit.
    """
    ids, weights, mask = tables
    if features.ndim != 4:
        raise ShapeError(f"features: expected shape (B, n, C, V), got {tuple(features.shape)}")
    batch, num_cameras, channels, num_vertices = features.shape
    if tables.num_cameras != num_cameras:
        raise ShapeError(
            f"features: got {num_cameras} cameras, but the rig has {tables.num_cameras}; "
            "pass images in the order of rig.names"
        )
    if ids.ndim == 5 and len(ids) != batch:
        raise ShapeError(
            f"rig: expected one rig for each of {batch} samples or a shared one, got {len(ids)} rigs"
        )
    rows = features.transpose(2, 3).reshape(-1, channels)
    first_row = torch.arange(batch * num_cameras, device=ids.device).mul(num_vertices)
    bags = (ids + first_row.view(batch, 1, 1, num_cameras, 1)).reshape(-1, 3)
    weights = weights.to(features.dtype).expand(batch, *weights.shape[-4:]).reshape(-1, 3)
    values = F.embedding_bag(bags, rows, per_sample_weights=weights, mode="sum")
    values = values.view(batch, *ids.shape[-4:-1], channels).permute(0, 3, 4, 1, 2)
    return SweepVolume(values, mask.expand(batch, *mask.shape[-3:]).permute(0, 3, 1, 2))


class SphereSweep(nn.Module):
    """Sweep concentric icospheres around a rig through the cameras' icospheres.

    Args:
        level: of the icosphere whose vertices are swept.
        num_hypotheses: N.
        min_depth: radius of the smallest icosphere in metres.
        feature_level: level of the icospheres that the cameras' values are on; ``level`` when not given.

    Raises:
        ArgumentError: for a negative level, fewer than two hypotheses or a smallest depth that is not
            positive.

    Examples:
        >>> import torch
        >>> from sphericalvision.cameras import ring_rig
        >>> rig = ring_rig(2, radius=0.1)
        >>> sweep = SphereSweep(level=2, num_hypotheses=8, min_depth=0.5)
        >>> values, mask = sweep(torch.ones(1, 2, 5, 162), rig)
        >>> values.shape, mask.shape
        (torch.Size([1, 2, 5, 8, 162]), torch.Size([1, 2, 8, 162]))
    """

    directions: Tensor
    inverse_depths: Tensor

    def __init__(
        self, level: int, num_hypotheses: int, min_depth: float, feature_level: int | None = None
    ) -> None:
        super().__init__()
        check_hypotheses(num_hypotheses, min_depth)
        self.level = level
        self.num_hypotheses = num_hypotheses
        self.min_depth = min_depth
        self.feature_level = level if feature_level is None else feature_level
        # Exact in float64, cast to the dtype of the rig in use.
        self.register_buffer("directions", icosphere_vertices(level, torch.float64), persistent=False)
        hypotheses = inverse_depth_hypotheses(num_hypotheses, min_depth, torch.float64)
        self.register_buffer("inverse_depths", hypotheses, persistent=False)

    def tables(self, rig: CameraRig) -> SweepTables:
        """Return the tables of a rig, to be passed to ``forward`` in its place as often as wanted."""
        return sweep_tables(self.directions, self.inverse_depths, rig, self.feature_level)

    def forward(self, features: Tensor, rig: CameraRig | SweepTables) -> SweepVolume:
        """Sweep values ``(B, n, C, V)`` of the n cameras of a rig, or of its prepared tables.

        Raises:
            ShapeError: if the features are on another level or of another number of cameras than the rig.
        """
        expected = num_icosphere_vertices(self.feature_level)
        if features.ndim != 4 or features.shape[-1] != expected:
            raise ShapeError(
                f"features: expected shape (B, n, C, {expected}) on level {self.feature_level}, "
                f"got {tuple(features.shape)}"
            )
        return sphere_sweep(features, rig if isinstance(rig, SweepTables) else self.tables(rig))

    def extra_repr(self) -> str:
        level = f"level={self.level}, feature_level={self.feature_level}"
        return f"{level}, num_hypotheses={self.num_hypotheses}, min_depth={self.min_depth}"
