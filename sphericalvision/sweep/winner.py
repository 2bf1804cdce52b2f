# SPDX-License-Identifier: Apache-2.0
"""Winner takes all: the index of the smallest cost, refined to a fraction."""

from __future__ import annotations

import torch
from jaxtyping import Float, Shaped
from torch import Tensor


def winner_takes_all(cost: Float[Tensor, "B N V"]) -> Float[Tensor, "B V"]:
    """Return the index ``(B, V)`` of the smallest cost ``(B, N, V)``; infinite ones are left out.

    It is moved to the minimum of the parabola through the winner and its two neighbours, by less than half a
    hypothesis.

    Examples:
        >>> winner_takes_all(torch.tensor([[[4.0], [1.0], [2.0]]]))
        tensor([[1.2500]])
    """
    best, winner = cost.min(1)
    before = cost.gather(1, (winner - 1).clamp(min=0)[:, None]).squeeze(1)
    after = cost.gather(1, (winner + 1).clamp(max=cost.shape[1] - 1)[:, None]).squeeze(1)
    curvature = before - 2 * best + after
    fits = (winner > 0) & (winner < cost.shape[1] - 1) & curvature.isfinite() & (curvature > 0)
    return winner + torch.where(fits, (before - after) / (2 * curvature), 0.0)


def at_nearest_hypothesis(
    values: Shaped[Tensor, "B N V"], index: Float[Tensor, "B V"]
) -> Shaped[Tensor, "B V"]:
    """Return the values ``(B, N, V)`` of the hypothesis nearest to a fractional index ``(B, V)``, the first for NaN.

    Examples:
        >>> at_nearest_hypothesis(torch.tensor([[[5.0], [6.0], [7.0]]]), torch.tensor([[1.3]]))
        tensor([[6.]])
    """
    nearest = index.nan_to_num().round().long().clamp(0, values.shape[1] - 1)
    return values.gather(1, nearest[:, None]).squeeze(1)
