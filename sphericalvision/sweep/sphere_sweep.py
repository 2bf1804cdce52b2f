# SPDX-License-Identifier: Apache-2.0
"""Sphere sweep: what each camera sees at the points of concentric icospheres around the rig."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from sphericalvision.core import ShapeError
from sphericalvision.icosphere import icosphere_vertices, num_icosphere_vertices
from sphericalvision.sweep.hypotheses import check_hypotheses, inverse_depth_hypotheses
from sphericalvision.sweep.sweep_tables import SweepTables, sweep_tables

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
