# SPDX-License-Identifier: Apache-2.0
"""Depth without training, done well: correlation of the best cameras, smoothed along the lines of the icosphere."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.icosphere import Icosphere, level_from_num_vertices
from sphericalvision.sweep.cost import winner_takes_all
from sphericalvision.sweep.hypotheses import check_hypotheses, inverse_depth_hypotheses
from sphericalvision.sweep.matching import best_pairs_cost
from sphericalvision.sweep.regression import DepthIndex
from sphericalvision.sweep.smoothing import semi_global_smoothing
from sphericalvision.sweep.sphere_sweep import sphere_sweep, sweep_tables

if TYPE_CHECKING:
    from sphericalvision.cameras import CameraRig

__all__ = ["semi_global_sweep"]


@torch.no_grad()
def semi_global_sweep(
    sphere_images: Tensor,
    rig: CameraRig,
    num_hypotheses: int,
    min_depth: float,
    level: int | None = None,
    cost_level: int | None = None,
    substeps: int = 2,
    window: int = 1,
    small_penalty: float = 0.3,
    large_penalty: float = 3.6,
    contrast: float = 0.4,
) -> DepthIndex:
    """Return depth without training: the best cameras' correlation, and semi-global smoothing on the icosphere.

    At each vertex and hypothesis the pairs of cameras that see the point are compared by the correlation of what
    they see around it, and the better half of them counts (``best_pairs_cost``). These costs are smoothed along
    the straight lines of the icosphere (``semi_global_smoothing``), less where the colours change; the smallest
    wins, refined to a fraction by a parabola. Any rig, any number of cameras, no weights.

    Where nothing is seen by two cameras, or nothing can be told, the index is that of the surroundings; the
    confidence tells.

    Args:
        sphere_images: ``(B, n, 3, V_image)`` in [-1, 1] on icospheres aligned with the world, in the order of
            ``rig.names``; 0 in all colours where there is nothing (masked).
        rig: of n cameras, two or more, for all samples or, with batched poses, a rig a sample.
        num_hypotheses: N, which index is returned in.
        min_depth: smallest depth in metres.
        level: of the result; two below the images' when not given, as ``IcoSweepNet`` has it.
        cost_level: at which cameras are compared; one below the images' when not given.
        substeps: hypotheses tried for each of the N: two are about a vertex of the images apart when one is two.
        window: rounds of averaging over neighbours within which cameras are compared, 0 or more.
        small_penalty: of a change by one (tried) hypothesis between neighbours; a cost is 0 to 1.
        large_penalty: of any larger change, where colours do not change.
        contrast: change of colour that halves the large penalty, in the unit of the images.

    Returns:
        Index ``(B, V_level)``, 0 to N - 1, and confidence ``(B, V_level)``: the correlation of the best cameras
        at the nearest tried hypothesis, 0 where fewer than two cameras see that point. Neither has a gradient.

    Raises:
        ShapeError: if the images have another shape.
        ArgumentError: if a level is above the images', the result's above the costs', or an option is out of
            its range.

    References:
        Hirschmüller (2008), "Stereo processing by semiglobal matching and mutual information"; Komatsu et al.
        (2020), "360° depth estimation from multiple fisheye images with origami crown representation of
        icosahedron", section III-C (the sweep).

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> images = torch.rand(1, 4, 3, 642, generator=torch.Generator().manual_seed(0))
        >>> index, confidence = semi_global_sweep(images, ring_rig(4), num_hypotheses=8, min_depth=0.5)
        >>> index.shape
        torch.Size([1, 42])
    """
    if sphere_images.ndim != 4 or sphere_images.shape[2] != 3 or sphere_images.shape[1] < 2:
        raise ShapeError(
            "sphere_images: expected shape (B, n, 3, V) of two or more cameras, got "
            f"{tuple(sphere_images.shape)}"
        )
    check_hypotheses(num_hypotheses, min_depth)
    image_level = level_from_num_vertices(sphere_images.shape[-1])
    level = max(image_level - 2, 0) if level is None else level
    cost_level = max(image_level - 1, level) if cost_level is None else cost_level
    if not 0 <= level <= cost_level <= image_level:
        raise ArgumentError(
            f"level, cost_level: expected 0 <= level <= cost_level <= {image_level}, the level of the images, "
            f"got {level} and {cost_level}"
        )
    if substeps < 1 or window < 0:
        raise ArgumentError(f"substeps, window: expected at least 1 and 0, got {substeps} and {window}")

    number = (num_hypotheses - 1) * substeps + 1
    inverse_depths = inverse_depth_hypotheses(number, min_depth, device=sphere_images.device)
    cost, guide = _sweep(sphere_images, rig, inverse_depths, cost_level, window)
    smooth = semi_global_smoothing(_neutral(cost), small_penalty, large_penalty, guide, contrast)
    for finer_level in range(cost_level, level, -1):
        ids = Icosphere(finer_level, device=cost.device).coarse_ids
        smooth, cost = smooth[..., ids], cost[..., ids]
    index = winner_takes_all(smooth, subhypothesis=True).index
    at_winner = cost.gather(1, index.round().long()[:, None]).squeeze(1)
    return DepthIndex(index / substeps, 1 - at_winner.clamp(max=1))


class _SweptCosts(NamedTuple):
    """Costs ``(B, N, V)``, infinite below two cameras, and the colours ``(B, 3, V)`` of the least of them."""

    cost: Tensor
    guide: Tensor


def _sweep(images: Tensor, rig: CameraRig, inverse_depths: Tensor, level: int, window: int) -> _SweptCosts:
    """Compare the cameras at one hypothesis after the other; no more than one is in memory in colours."""
    grid = Icosphere(level, images.dtype, images.device)
    image_level = level_from_num_vertices(images.shape[-1])
    costs: list[Tensor] = []
    least = images.new_full((len(images), grid.num_vertices), torch.inf)
    guide = images.new_zeros(len(images), 3, grid.num_vertices)
    for inverse_depth in inverse_depths:
        tables = sweep_tables(grid.vertices, inverse_depth[None], rig, image_level)
        swept = sphere_sweep(images, tables)
        values, mask = swept.values.squeeze(3), swept.seen.squeeze(2)
        mask = mask & (values != 0).any(2)
        cost = best_pairs_cost(values, mask, window)
        mean = values.sum(1) / mask.sum(1)[:, None].clamp(min=1)
        better = (cost < least) | (len(costs) == 0)  # of the first where nothing is seen by two
        guide = torch.where(better[:, None], mean, guide)
        least = torch.minimum(least, cost)
        costs.append(cost)
    return _SweptCosts(torch.stack(costs, 1), guide)


def _neutral(cost: Tensor) -> Tensor:
    """Give unseen hypotheses the mean of the seen ones at their vertex, so that nothing speaks for or against them."""
    seen = cost.isfinite()
    count = seen.sum(1, keepdim=True)
    mean = torch.where(seen, cost, 0.0).sum(1, keepdim=True) / count.clamp(min=1)
    return torch.where(seen, cost, mean.where(count > 0, 1.0))
