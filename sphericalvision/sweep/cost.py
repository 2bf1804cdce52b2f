# SPDX-License-Identifier: Apache-2.0
"""Photo-consistency: a sphere sweep that needs no training, and the baseline for those that do."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.icosphere import Icosphere, level_from_num_vertices
from sphericalvision.sweep.hypotheses import check_hypotheses, inverse_depth_hypotheses
from sphericalvision.sweep.regression import DepthIndex
from sphericalvision.sweep.sphere_sweep import sphere_sweep, sweep_tables

if TYPE_CHECKING:
    from sphericalvision.cameras import CameraRig

__all__ = ["local_appearance", "photo_consistency", "winner_takes_all"]


def photo_consistency(
    sphere_images: Tensor,
    rig: CameraRig,
    num_hypotheses: int,
    min_depth: float,
    level: int | None = None,
    aggregation: int = 0,
    subhypothesis: bool = False,
) -> DepthIndex:
    """Return, at each vertex, the hypothesis at which the cameras that see the point agree best.

    The cost of a hypothesis is the mean absolute deviation of the cameras' ``local_appearance`` from their
    mean, over those cameras (at least two) whose field of view holds the point. The smallest cost wins; where
    no hypothesis is seen by two cameras the index is 0 (infinity) and the confidence 0.

    Args:
        sphere_images: ``(B, n, 3, V_image)`` in [-1, 1] on icospheres aligned with the world, in the order of
            ``rig.names``.
        rig: of n cameras, for all samples or, with batched poses, a rig a sample.
        num_hypotheses: N.
        min_depth: smallest depth in metres.
        level: of the result; two below the images' when not given, as ``IcoSweepNet`` has it.
        aggregation: rounds of averaging the cost over the neighbours of a vertex. With one or more, costs are
            computed at the level of the images: steadier, and 16 times the work at the default ``level``.
        subhypothesis: whether to refine the winner to a fraction by a parabola through its neighbours' costs.

    Returns:
        Index ``(B, V_level)``, 0 to N - 1, and confidence ``(B, V_level)``: 1 minus the ratio of the best to
        the mean cost.

    Raises:
        ShapeError: if the images have another shape.
        ArgumentError: if the level is above the images', or the aggregation is negative.

    References:
        Collins (1996), "A space-sweep approach to true multi-image matching".

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> rig = ring_rig(2, radius=0.1)
        >>> index, confidence = photo_consistency(torch.rand(1, 2, 3, 642), rig, num_hypotheses=8,
        ...     min_depth=0.5)
        >>> index.shape
        torch.Size([1, 42])
    """
    if sphere_images.ndim != 4 or sphere_images.shape[2] != 3:
        raise ShapeError(f"sphere_images: expected shape (B, n, 3, V), got {tuple(sphere_images.shape)}")
    check_hypotheses(num_hypotheses, min_depth)
    image_level = level_from_num_vertices(sphere_images.shape[-1])
    level = max(image_level - 2, 0) if level is None else level
    if not 0 <= level <= image_level:
        raise ArgumentError(f"level: expected 0 to {image_level}, the level of the images, got {level}")
    if aggregation < 0:
        raise ArgumentError(f"aggregation: expected 0 or more rounds, got {aggregation}")

    grid = Icosphere(image_level if aggregation else level, sphere_images.dtype, sphere_images.device)
    appearance = local_appearance(sphere_images)
    costs = []
    for inverse_depth in inverse_depth_hypotheses(num_hypotheses, min_depth, device=grid.vertices.device):
        tables = sweep_tables(grid.vertices, inverse_depth[None], rig, image_level)
        values, mask = sphere_sweep(appearance, tables)
        costs.append(_disagreement(values.squeeze(3), mask.squeeze(2)))
    cost = torch.stack(costs, 1)
    for _ in range(aggregation):
        cost = _neighborhood_mean(cost, grid.neighbors)
    for finer_level in range(grid.level, level, -1):
        cost = cost[..., Icosphere(finer_level, device=cost.device).coarse_ids]
    return winner_takes_all(cost, subhypothesis)


def local_appearance(images: Tensor) -> Tensor:
    """Describe the neighbourhood of each vertex of images ``(*, 3, V)`` by seven channels ``(*, 7, V)``.

    Brightness less the mean of the vertex and its neighbours, and the brightness gradient as a vector in
    space, both divided by the neighbourhood's contrast (so that exposure does not matter), and the three
    colours at half weight. A vector in space needs no tangent frame, so cameras agree wherever they look.

    Examples:
        >>> local_appearance(torch.zeros(2, 3, 162)).shape
        torch.Size([2, 7, 162])
    """
    if images.ndim < 2 or images.shape[-2] != 3:
        raise ShapeError(f"images: expected shape (*, 3, V), got {tuple(images.shape)}")
    grid = Icosphere(level_from_num_vertices(images.shape[-1]), images.dtype, images.device)
    neighbors = grid.neighbors
    present = (neighbors >= 0).to(images.dtype)
    count = present.sum(1)
    brightness = images.mean(-2)
    around = (brightness[..., neighbors.clamp(min=0)] - brightness[..., None]) * present
    mean = around.sum(-1) / (count + 1)
    contrast = ((around - mean[..., None]).square() * present).sum(-1) / count
    scale = (contrast.sqrt() + 0.05).reciprocal()
    edges = grid.vertices[neighbors.clamp(min=0)] - grid.vertices[:, None]
    edges = torch.nn.functional.normalize(edges, dim=-1) * present[..., None]
    gradient = torch.einsum("...vk,vkd->...dv", around, edges) * (2 / count)
    relative = torch.cat((-mean[..., None, :], gradient), -2) * scale[..., None, :]
    return torch.cat((relative, 0.5 * images), -2)


def winner_takes_all(cost: Tensor, subhypothesis: bool = False) -> DepthIndex:
    """Return the hypothesis of the smallest cost ``(B, N, V)``; infinite ones are left out.

    With ``subhypothesis`` the index is moved to the minimum of the parabola through the winner and its two
    neighbours, by less than half a hypothesis.

    Examples:
        >>> winner_takes_all(torch.tensor([[[4.0], [1.0], [2.0]]]), subhypothesis=True).index
        tensor([[1.2500]])
    """
    best, winner = cost.min(1)
    index = winner.to(cost.dtype)
    if subhypothesis:
        before = cost.gather(1, (winner - 1).clamp(min=0)[:, None]).squeeze(1)
        after = cost.gather(1, (winner + 1).clamp(max=cost.shape[1] - 1)[:, None]).squeeze(1)
        curvature = before - 2 * best + after
        fits = (winner > 0) & (winner < cost.shape[1] - 1) & curvature.isfinite() & (curvature > 0)
        index = index + torch.where(fits, (before - after) / (2 * curvature), 0.0)
    seen = cost.isfinite()
    mean = torch.where(seen, cost, 0.0).sum(1) / seen.sum(1).clamp(min=1)
    confidence = torch.where(seen.any(1), 1 - best / mean.clamp(min=1e-12), 0.0)
    return DepthIndex(index, confidence.clamp(0, 1))


def _disagreement(values: Tensor, mask: Tensor) -> Tensor:
    """Return the cost ``(B, V)`` of values ``(B, n, C, V)`` with mask ``(B, n, V)``; infinite below two."""
    seen = mask[:, :, None].to(values.dtype)
    count = seen.sum(1)
    mean = (values * seen).sum(1) / count.clamp(min=1)
    deviation = ((values - mean[:, None]).abs() * seen).sum(1) / count.clamp(min=1)
    # The deviation of k samples from their own mean is too small on average by this factor; without it, two
    # cameras would always agree better than three.
    unbiased = (count / (count - 1).clamp(min=1)).sqrt().squeeze(1)
    return torch.where(count.squeeze(1) >= 2, deviation.mean(1) * unbiased, torch.inf)


def _neighborhood_mean(cost: Tensor, neighbors: Tensor) -> Tensor:
    """Average ``(B, N, V)`` over each vertex and its neighbours, without infinite (unseen) costs."""
    seen = cost.isfinite()
    finite = torch.where(seen, cost, 0.0)
    total, count = finite, seen.to(cost.dtype)
    for column in neighbors.unbind(1):
        present = (column >= 0).to(cost.dtype)
        total = total + finite[..., column.clamp(min=0)] * present
        count = count + seen[..., column.clamp(min=0)] * present
    return torch.where(seen, total / count.clamp(min=1), torch.inf)
