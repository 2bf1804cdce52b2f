# SPDX-License-Identifier: Apache-2.0
"""Sphere sweep: the cameras' values at the points of concentric icospheres around the rig."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.core import ShapeError
from sphericalvision.geometry.lookup import PlacesInSinglePrecision, weighted_rows
from sphericalvision.icosphere import icosphere_vertices, level_from_num_vertices, num_icosphere_vertices
from sphericalvision.icosphere.topology import check_level
from sphericalvision.shapes import check_shapes
from sphericalvision.sweep.hypotheses import check_hypotheses, inverse_depth_hypotheses
from sphericalvision.sweep.ring_mean import ids_of_coarser_level
from sphericalvision.sweep.sweep_tables import SweepTables, sweep_tables

if TYPE_CHECKING:
    from sphericalvision.cameras import CameraRig


class SweepVolume(NamedTuple):
    """Values of n cameras at N hypotheses.

    Attributes:
        values: ``(B, n, C, N, V)``, zero outside the fields of view.
        seen: ``(B, n, N, V)`` True where a camera sees the point: inside its field of view, and where its image shows
            something; occlusion is not known. It may be an expanded view.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> values, seen = SphereSweep(level=2, num_hypotheses=4, min_depth=0.5)(torch.rand(1, 2, 3, 162), ring_rig(2))
        >>> values.shape, seen.shape
        (torch.Size([1, 2, 3, 4, 162]), torch.Size([1, 2, 4, 162]))
    """

    values: Float[Tensor, "B n C N *grid"]
    seen: Bool[Tensor, "B n N *grid"]


@check_shapes
def sphere_sweep(
    features: Float[Tensor, "B n C V_f"],
    tables: SweepTables,
    seen: Bool[Tensor, "#B n V_f"] | Bool[Tensor, "n V_f"] | None = None,
) -> SweepVolume:
    """Look up the values of every camera at every hypothesis.

    Args:
        features: ``(B, n, C, V_f)`` values on the cameras' icospheres.
        tables: of n cameras, for all of the batch or with a batch dimension B.
        seen: ``([B,] n, V_f)`` True where the cameras' images show something; everywhere when not given.

    Returns:
        Values ``(B, n, C, N, V)``, zero out of view, and where they were seen. In memory cameras and channels are
        innermost.

    Raises:
        ShapeError: if features, tables and ``seen`` do not fit.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> tables = SphereSweep(level=2, num_hypotheses=8, min_depth=0.5).tables(ring_rig(2, radius=0.1))
        >>> sphere_sweep(torch.ones(1, 2, 5, 162), tables).values.shape
        torch.Size([1, 2, 5, 8, 162])
    """
    values = _look_up(features, tables)
    points_seen = tables.seen if seen is None else _points_seen(seen, tables)
    return SweepVolume(
        values, points_seen.expand(features.shape[0], *points_seen.shape[-3:]).permute(0, 3, 1, 2)
    )


def _points_seen(seen: Tensor, tables: SweepTables) -> Tensor:
    """Whether more than half of the weights at a point are on vertices seen ``([B,] n, V_f)``: ``([B,] N, V, n)``."""
    seen = seen[None] if seen.ndim == 2 else seen
    if tables.seen.ndim == 4:
        seen = seen.expand(len(tables.seen), *seen.shape[1:])
    fraction = _look_up(seen.unsqueeze(2).to(tables.weights), tables)[:, :, 0].permute(0, 2, 3, 1)
    return tables.seen & (fraction > 0.5)


def _look_up(features: Tensor, tables: SweepTables) -> Tensor:
    """Values ``(B, n, C, N, V)`` of features ``(B, n, C, V_f)``, linear in each triangle."""
    ids, weights, _ = tables
    batch, num_cameras, channels, num_vertices = features.shape
    if tables.num_cameras != num_cameras:
        raise ShapeError(
            f"features: got {num_cameras} cameras, but the rig has {tables.num_cameras}; "
            "pass images in the order of rig.names"
        )
    if ids.ndim == 5 and ids.shape[0] != batch:
        raise ShapeError(
            f"rig: expected one rig for each of {batch} samples or a shared one, got {len(ids)} rigs"
        )
    rows = features.transpose(2, 3).reshape(-1, channels)
    first_row = torch.arange(0, batch * num_cameras * num_vertices, num_vertices, device=ids.device)
    bags = (ids + first_row.view(batch, 1, 1, num_cameras, 1)).reshape(-1, 3)
    weights = weights.to(features.dtype).expand(batch, *weights.shape[-4:]).reshape(-1, 3)
    values = weighted_rows(rows, bags, weights)
    return values.view(batch, *ids.shape[-4:-1], channels).permute(0, 3, 4, 1, 2)


class SphereSweep(PlacesInSinglePrecision):
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
        >>> values, seen = sweep(torch.ones(1, 2, 5, 162), rig)
        >>> values.shape, seen.shape
        (torch.Size([1, 2, 5, 8, 162]), torch.Size([1, 2, 8, 162]))
    """

    directions: Tensor
    inverse_depths: Tensor

    def __init__(
        self, level: int, num_hypotheses: int, min_depth: float, feature_level: int | None = None
    ) -> None:
        super().__init__()
        check_hypotheses(num_hypotheses, min_depth)
        check_level(level)
        self.level = level
        self.num_hypotheses = num_hypotheses
        self.min_depth = min_depth
        self.feature_level = level if feature_level is None else check_level(feature_level)
        # Exact in float64, cast to the dtype of the rig in use.
        self.register_buffer("directions", icosphere_vertices(level, torch.float64), persistent=False)
        hypotheses = inverse_depth_hypotheses(num_hypotheses, min_depth, torch.float64)
        self.register_buffer("inverse_depths", hypotheses, persistent=False)

    def tables(self, rig: CameraRig) -> SweepTables:
        """Return the tables of a rig, which may be passed to ``forward`` in its place."""
        return sweep_tables(self.directions, self.inverse_depths, rig, self.feature_level)

    @check_shapes
    def forward(
        self,
        features: Float[Tensor, "B n C V_f"],
        rig: CameraRig | SweepTables,
        seen: Bool[Tensor, "#B n V_s"] | Bool[Tensor, "n V_s"] | None = None,
    ) -> SweepVolume:
        """Sweep values ``(B, n, C, V)`` of the n cameras of a rig.

        Args:
            features: on icospheres of ``feature_level``.
            rig: of n cameras, for all of the batch or a rig a sample; or its ``tables``.
            seen: ``([B,] n, V_s)`` True where the images show something, on icospheres of ``feature_level`` or finer
                ones; everywhere when not given.

        Raises:
            ShapeError: if the features are on another level or of another number of cameras than the rig.
        """
        expected = num_icosphere_vertices(self.feature_level)
        if features.shape[-1] != expected:
            raise ShapeError(
                f"features: expected shape (B, n, C, {expected}) on level {self.feature_level}, "
                f"got {tuple(features.shape)}"
            )
        tables = rig if isinstance(rig, SweepTables) else self.tables(rig)
        tried = self.num_hypotheses, len(self.directions)
        if tuple(tables.ids.shape[-4:-2]) != tried:
            raise ShapeError(
                f"rig: expected tables of {tried[0]} hypotheses at {tried[1]} vertices, as this sweep makes them, got "
                f"{tables.ids.shape[-4]} at {tables.ids.shape[-3]}; those of another level or number of hypotheses "
                "point elsewhere"
            )
        if seen is not None and (level := level_from_num_vertices(seen.shape[-1])) > self.feature_level:
            seen = seen[..., ids_of_coarser_level(level, self.feature_level, seen.device)]
        return sphere_sweep(features, tables, seen)

    def extra_repr(self) -> str:
        level = f"level={self.level}, feature_level={self.feature_level}"
        return f"{level}, num_hypotheses={self.num_hypotheses}, min_depth={self.min_depth}"
