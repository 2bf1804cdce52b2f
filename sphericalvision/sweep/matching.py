# SPDX-License-Identifier: Apache-2.0
"""How well cameras agree at a point: correlation of what they see around it, over the pairs that agree best."""

from __future__ import annotations

import itertools

import torch
import torch.nn.functional as F
from torch import Tensor

from sphericalvision.core import ShapeError
from sphericalvision.icosphere import icosphere_neighbors, level_from_num_vertices

__all__ = ["best_pairs_cost", "ring_mean"]


def ring_mean(values: Tensor, rounds: int = 1) -> Tensor:
    """Average values ``(V, *)`` over each vertex of an icosphere and its neighbours, ``rounds`` times.

    Vertices come first, unlike elsewhere: what is averaged together then lies side by side in memory.

    Examples:
        >>> peak = torch.zeros(42, 1)
        >>> peak[0] = 6.0  # the north pole, which has five neighbours
        >>> ring_mean(peak)[:2].flatten()
        tensor([1.0000, 0.8571])
    """
    neighbors = icosphere_neighbors(level_from_num_vertices(len(values)), values.device)
    own = torch.arange(len(values), device=values.device)[:, None]
    ids = torch.cat((own, neighbors.clamp(min=0)), 1)
    present = (torch.cat((own, neighbors), 1) >= 0).to(values.dtype)
    weights = present / present.sum(1, keepdim=True)
    rows = values.flatten(1)
    for _ in range(rounds):
        rows = F.embedding_bag(ids, rows, per_sample_weights=weights, mode="sum")
    return rows.view_as(values)


def best_pairs_cost(values: Tensor, mask: Tensor, rounds: int = 1, noise: float = 0.01) -> Tensor:
    """Return how much the pairs of cameras that agree best disagree at each vertex, 0 (not at all) to 1.

    Two cameras agree as far as what they see around the vertex correlates, whatever their exposures: each colour
    less its mean around the vertex, divided by the contrast of all colours together. Of the pairs that see the
    point the better half counts, so that a camera whose view is blocked does no harm. Where there is nothing
    but ``noise`` to compare the cost is near 1 whatever the hypothesis, and so it is where cameras contradict
    each other.

    Args:
        values: ``(B, n, C, V)`` what n cameras see at the points of one hypothesis.
        mask: ``(B, n, V)`` True where a camera sees the point.
        rounds: of averaging over neighbours, which make the window that is compared: a ring for 1.
        noise: contrast below which nothing is told, in the unit of the values.

    Returns:
        ``(B, V)``; infinite where fewer than two cameras see the point.

    Raises:
        ShapeError: if values and mask do not fit.

    References:
        Goesele et al. (2007), "Multi-view stereo for community photo collections", section 6 (view selection);
        Kang, Szeliski and Chai (2001), "Handling occlusions in dense multi-view stereo" (best half).

    Examples:
        >>> texture = torch.rand(1, 1, 3, 642).expand(1, 2, 3, 642)
        >>> agree = best_pairs_cost(texture, torch.ones(1, 2, 642, dtype=torch.bool))
        >>> bool(agree.max() < 0.01)
        True
    """
    if values.ndim != 4 or mask.shape != (*values.shape[:2], values.shape[-1]):
        raise ShapeError(
            f"values and mask: expected shapes (B, n, C, V) and (B, n, V), got {tuple(values.shape)} and "
            f"{tuple(mask.shape)}"
        )
    seen = mask.permute(2, 0, 1).to(values.dtype)  # (V, B, n)
    colors = values.permute(3, 0, 1, 2) * seen[..., None]
    weight = ring_mean(seen, rounds).clamp(min=1e-6)
    local = (colors - ring_mean(colors, rounds) / weight[..., None]) * seen[..., None]
    variance = ring_mean(local.square().sum(-1), rounds) / weight + noise**2
    first, second = zip(*itertools.combinations(range(values.shape[1]), 2), strict=True)
    both = seen[..., first] * seen[..., second]  # (V, B, pairs)
    product = (local[..., first, :] * local[..., second, :]).sum(-1)
    covariance = ring_mean(product, rounds) / ring_mean(both, rounds).clamp(min=1e-6)
    correlation = covariance * (variance[..., first] * variance[..., second]).rsqrt()
    cost = torch.where(both > 0, (1 - correlation).clamp(0, 1), torch.inf)
    return _mean_of_better_half(cost).T


def _mean_of_better_half(cost: Tensor) -> Tensor:
    """Average the smaller half, rounded up, of the finite costs ``(*, k)``; infinite if there are none."""
    ordered = cost.sort(-1).values
    count = (cost.isfinite().sum(-1, keepdim=True) + 1) // 2
    counts = torch.arange(cost.shape[-1], device=cost.device) < count
    total = torch.where(counts, ordered, 0.0).sum(-1)
    return torch.where(count.squeeze(-1) > 0, total / count.squeeze(-1).clamp(min=1), torch.inf)
