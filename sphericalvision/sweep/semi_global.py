# SPDX-License-Identifier: Apache-2.0
"""Depth without training: correlation of the best cameras, smoothed along the lines of the icosphere."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.geometry.directions import in_single_precision
from sphericalvision.icosphere import icosphere_vertices, level_from_num_vertices
from sphericalvision.icosphere.topology import check_level
from sphericalvision.shapes import check_shapes
from sphericalvision.sweep.confidence import sweep_confidence
from sphericalvision.sweep.correlation import LEAST_SHARE, NOISE, correlation_evidence
from sphericalvision.sweep.hypotheses import check_hypotheses, inverse_depth_hypotheses
from sphericalvision.sweep.regression import DepthEstimate
from sphericalvision.sweep.ring_mean import ids_of_coarser_level
from sphericalvision.sweep.smoothing import semi_global_smoothing
from sphericalvision.sweep.sphere_sweep import sphere_sweep
from sphericalvision.sweep.sweep_tables import SweepTables, sweep_tables
from sphericalvision.sweep.visibility import check_seen, seen_in_view
from sphericalvision.sweep.winner import at_nearest_hypothesis, winner_takes_all

if TYPE_CHECKING:
    from sphericalvision.cameras import CameraRig


class SemiGlobalTables(NamedTuple):
    """Tables of a rig for ``semi_global_sweep``.

    Attributes:
        sweep: of the points of all tried hypotheses.
        seen: ``([B,] n, V_image)`` True inside the camera's field of view and mask.
    """

    sweep: SweepTables
    seen: Bool[Tensor, "*B n V_image"]

    def to(self, device: torch.device | str) -> SemiGlobalTables:
        """Return the tables on another device."""
        return SemiGlobalTables(self.sweep.to(device), self.seen.to(device))


class SmoothedCosts(NamedTuple):
    """Smoothed costs of M tried hypotheses.

    Attributes:
        evidence: ``(B, 3, M, V)`` of ``correlation_evidence``.
        cost: ``(B, M, V)`` smoothed; the smallest wins, and their negatives are logits.
    """

    evidence: Float[Tensor, "B 3 M V"]
    cost: Float[Tensor, "B M V"]


@torch.no_grad()
@check_shapes
def semi_global_sweep(
    sphere_images: Float[Tensor, "B n 3 V_image"],
    rig: CameraRig | SemiGlobalTables,
    num_hypotheses: int,
    min_depth: float,
    level: int | None = None,
    cost_level: int | None = None,
    substeps: int = 2,
    small_penalty: float = 0.3,
    large_penalty: float = 3.6,
    contrast: float = 0.4,
    seen: Bool[Tensor, "B n V_image"] | Bool[Tensor, "n V_image"] | None = None,
) -> DepthEstimate:
    """Return depth without training, by correlation between cameras and semi-global smoothing on the icosphere.

    The cost of a hypothesis is 1 less the correlation of the colours around its point, over the better half of the
    pairs of cameras that see it (``correlation_evidence``). Costs are smoothed along the straight lines of the
    icosphere, less where colours change (``semi_global_smoothing``). The smallest wins, and is refined by a parabola.

    Where fewer than two cameras see the point, or there is no texture, the index is that of the surroundings; ``seen``
    and the confidence show where.

    Args:
        sphere_images: ``(B, n, 3, V_image)`` in [-1, 1] on icospheres aligned with the world, in the order of
            ``rig.names``.
        rig: of n cameras, two or more, for all samples or, with batched poses, a rig a sample; or
            ``semi_global_tables`` of either, which save most of the work and have their own ``cost_level`` and
            ``substeps``.
        num_hypotheses: N.
        min_depth: smallest depth in metres.
        level: of the result; two below the images' when not given, as ``IcoSweepNet`` has it.
        cost_level: at which cameras are compared; one below the images' when not given.
        substeps: hypotheses tried for each of the N.
        small_penalty: of a change by one (tried) hypothesis between neighbours; a cost is 0 to 1.
        large_penalty: of any larger change, where colours do not change.
        contrast: change of colour that halves the large penalty, in the unit of the images.
        seen: ``([B,] n, V_image)``, True where the images show something; by default the rig's views less its masks.

    Returns:
        Index ``(B, V_level)``, 0 to N - 1; confidence ``(B, V_level)``; and whether two cameras see the point at the
        nearest tried hypothesis, without which the confidence is 0. None has a gradient.

    Raises:
        ArgumentError: if a level is above the images', the result's above the costs', or an option is out of
            its range.

    References:
        Hirschmüller (2008), "Stereo processing by semiglobal matching and mutual information"; Komatsu et al.
        (2020), "360° depth estimation from multiple fisheye images with origami crown representation of
        icosahedron", section III-C (the sweep).

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> images = torch.rand(1, 4, 3, 642, generator=torch.Generator().manual_seed(0))
        >>> index, confidence, seen = semi_global_sweep(images, ring_rig(4), num_hypotheses=8, min_depth=0.5)
        >>> index.shape
        torch.Size([1, 42])
    """
    if sphere_images.shape[1] < 2:
        raise ShapeError(
            f"sphere_images: expected two or more cameras, (B, n, 3, V), got shape {tuple(sphere_images.shape)}"
        )
    sphere_images = in_single_precision(sphere_images)
    check_hypotheses(num_hypotheses, min_depth)
    image_level = level_from_num_vertices(sphere_images.shape[-1])
    level = max(image_level - 2, 0) if level is None else check_level(level)
    if isinstance(rig, SemiGlobalTables):
        check_tables(rig.seen, sphere_images)
        cost_level = level_from_num_vertices(rig.sweep.ids.shape[-3])
    elif cost_level is None:
        cost_level = max(image_level - 1, level)
    if not 0 <= level <= cost_level <= image_level:
        raise ArgumentError(
            f"level, cost_level: expected 0 <= level <= cost_level <= {image_level}, the level of the images, "
            f"got {level} and {cost_level}"
        )
    device = sphere_images.device
    tables = (
        rig
        if isinstance(rig, SemiGlobalTables)
        else semi_global_tables(rig, num_hypotheses, min_depth, image_level, cost_level, substeps, device)
    )
    substeps, rest = divmod(tables.sweep.ids.shape[-4] - 1, num_hypotheses - 1)
    if rest:
        raise ArgumentError(
            f"rig: expected tables for {num_hypotheses} hypotheses, got {tables.sweep.ids.shape[-4]} tried ones"
        )
    evidence, smooth = semi_global_costs(
        sphere_images,
        tables.sweep,
        tables.seen if seen is None else seen,
        small_penalty,
        large_penalty,
        contrast,
    )
    index = winner_takes_all(smooth)
    cameras = at_nearest_hypothesis(evidence[:, 2], index)
    correlation = at_nearest_hypothesis(evidence[:, 1], index)
    confidence = sweep_confidence(smooth, correlation, index, substeps).where(cameras >= 2, 0.0)
    ids = ids_of_coarser_level(cost_level, level, smooth.device)
    return DepthEstimate(index[:, ids] / substeps, confidence[:, ids], cameras[:, ids] >= 2)


def semi_global_tables(
    rig: CameraRig,
    num_hypotheses: int,
    min_depth: float,
    image_level: int,
    cost_level: int | None = None,
    substeps: int = 2,
    device: torch.device | str | None = None,
) -> SemiGlobalTables:
    """Return the tables of a rig for ``semi_global_sweep``; arguments as there, and the rig's device when not given.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> tables = semi_global_tables(ring_rig(4), num_hypotheses=8, min_depth=0.5, image_level=3)
        >>> tables.sweep.ids.shape, tables.seen.shape
        (torch.Size([15, 162, 4, 3]), torch.Size([4, 642]))
    """
    cost_level = max(check_level(image_level) - 1, 0) if cost_level is None else check_level(cost_level)
    if substeps < 1:
        raise ArgumentError(f"substeps: expected at least 1, got {substeps}")
    check_hypotheses(num_hypotheses, min_depth)
    dtype = rig.world_from_camera.dtype
    device = rig.world_from_camera.device if device is None else device
    number = (num_hypotheses - 1) * substeps + 1
    inverse_depths = inverse_depth_hypotheses(number, min_depth, dtype, device)
    sweep = sweep_tables(icosphere_vertices(cost_level, dtype, device), inverse_depths, rig, image_level)
    return SemiGlobalTables(sweep, seen_in_view(rig, image_level).to(device))


def check_tables(seen: Bool[Tensor, "*B n V_tables"], images: Float[Tensor, "B n C V_image"]) -> None:
    """Raise ``ShapeError`` unless tables, of which ``seen`` is given, are for images of this size."""
    if seen.shape[-1] != images.shape[-1]:
        raise ShapeError(
            f"rig: expected tables for images of {images.shape[-1]} vertices, got those for {seen.shape[-1]}; take "
            "the rig itself, or tables made for this level"
        )


@check_shapes
def semi_global_costs(
    images: Float[Tensor, "B n C V_image"],
    tables: SweepTables,
    seen: Bool[Tensor, "B n V_image"] | Bool[Tensor, "n V_image"] | None = None,
    small_penalty: float = 0.3,
    large_penalty: float = 3.6,
    contrast: float = 0.4,
    noise: float = NOISE,
) -> SmoothedCosts:
    """Return correlations and smoothed costs at the level and hypotheses of a sweep's tables.

    Args:
        images: ``(B, n, C, V_image)``, see ``correlation_evidence``.
        tables: of the sweep.
        seen: ``([B,] n, V_image)``, True where the images show something.
        small_penalty: see ``semi_global_smoothing``.
        large_penalty: see there.
        contrast: see there.
        noise: see ``correlation_evidence``.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> tables = semi_global_tables(ring_rig(4), 8, 0.5, image_level=3, substeps=1)
        >>> images = torch.rand(1, 4, 3, 642, generator=torch.Generator().manual_seed(0))
        >>> evidence, cost = semi_global_costs(images, tables.sweep, tables.seen)
        >>> cost.shape
        torch.Size([1, 8, 162])
    """
    images = in_single_precision(images)
    evidence = correlation_evidence(images, tables, seen, noise=noise)
    _, best, cameras = evidence.unbind(1)
    valid = cameras >= 2
    # Hypotheses that two cameras do not see are neither likely nor unlikely: they cost the mean of the others.
    count = valid.sum(1, keepdim=True)
    cost = 1 - best
    average = cost.masked_fill(~valid, 0.0).sum(1, keepdim=True) / count.clamp(min=1)
    cost = torch.where(valid, cost, average.masked_fill(count == 0, 1.0))
    winner = cost.masked_fill(~valid, torch.inf).min(1).indices  # as argmin, which takes four times as long
    # Colours show where depth may jump, but there is no image from the centre: the cameras' colours at the cheapest
    # hypothesis before smoothing take its place.
    visible = torch.ones_like(images[:, :, 0]) if seen is None else check_seen(seen, images).to(images)
    guide = _colors_at(images, visible, tables, winner)
    return SmoothedCosts(evidence, semi_global_smoothing(cost, small_penalty, large_penalty, guide, contrast))


def _colors_at(images: Tensor, shown: Tensor, tables: SweepTables, winner: Tensor) -> Tensor:
    """Mean ``(B, C, V)`` over the cameras that see it of the colours at hypotheses ``(B, V)``."""
    batch, _, channels, _ = images.shape
    # One entry of the tables is picked for each vertex, so that the sweep looks up one hypothesis, not all.
    best = winner[:, None, :, None]
    chosen = []
    for table in (tables.ids, tables.weights, tables[2].unsqueeze(-1)):
        entries = table.view(-1, *table.shape[-4:])
        entries = entries.expand(batch, *entries.shape[1:])
        chosen.append(entries.gather(1, best[..., None].expand(-1, -1, -1, *entries.shape[-2:])))
    at_winner = SweepTables(chosen[0], chosen[1], chosen[2].squeeze(-1))
    # Weights are swept with the colours and divided out, so that masked vertices do not darken their neighbours.
    features = torch.cat((images * shown[:, :, None], shown[:, :, None]), 2)
    values = sphere_sweep(features, at_winner).values.squeeze(3).sum(1)  # over the cameras
    return values[:, :channels] / values[:, channels:].clamp(min=LEAST_SHARE)
