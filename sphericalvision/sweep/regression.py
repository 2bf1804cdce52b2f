# SPDX-License-Identifier: Apache-2.0
"""Regression from scores of hypotheses to an index: the expectation under a softmax, and its confidence."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.shapes import check_shapes
from sphericalvision.tables import constant_table


class DepthEstimate(NamedTuple):
    """Result of a network: hypothesis index, its confidence (0 to 1), and whether two cameras see the point.

    All have the shape of the network's grid, ``(B, V)`` or ``(B, h, w)``. Where ``seen`` is False the index is a guess
    from the surroundings.

    Examples:
        >>> index, confidence, seen = depth_estimate(torch.randn(1, 8, 42), torch.ones(1, 2, 8, 42, dtype=torch.bool))
        >>> index.shape, bool(seen.all())
        (torch.Size([1, 42]), True)
    """

    index: Float[Tensor, " B *grid"]  # type: ignore[assignment]  # hides tuple.index, which nobody needs here
    confidence: Float[Tensor, " B *grid"]
    seen: Bool[Tensor, " B *grid"]


@check_shapes
def depth_estimate(logits: Float[Tensor, "B N V"], seen: Bool[Tensor, "B n N V"]) -> DepthEstimate:
    """Return the expected index, its confidence and whether two cameras saw it, each ``(B, V)``.

    Args:
        logits: ``(B, N, V)``, the score of each hypothesis; higher is more likely. With a NaN, index and
            confidence are NaN.
        seen: ``(B, n, N, V)``, True where camera n saw the point of hypothesis N, as in ``SweepVolume``.

    Examples:
        >>> logits = torch.tensor([[[0.0], [20.0], [0.0]]])
        >>> seen = torch.tensor([True, True, False]).view(1, 1, 3, 1).expand(1, 2, 3, 1)
        >>> depth_estimate(logits, seen)
        DepthEstimate(index=tensor([[1.]]), confidence=tensor([[1.]]), seen=tensor([[True]]))
    """
    index = soft_argmax(logits)
    nearest = index.detach().nan_to_num().round().long()[:, None, None].expand(-1, seen.shape[1], 1, -1)
    return DepthEstimate(
        index, soft_argmax_confidence(logits), seen.gather(2, nearest).squeeze(2).sum(1) >= 2
    )


@check_shapes
def soft_argmax(logits: Float[Tensor, "*batch N V"]) -> Float[Tensor, "*batch V"]:
    """Return the expected hypothesis index ``(*b, V)``, 0 to N - 1, of scores ``(*b, N, V)``.

    The probability of a hypothesis is the softmax of the scores over all hypotheses: a higher score is more
    likely. Computed in float32 at least, also under autocast and of scores in half precision, and returned so.

    References:
        Kendall et al. (2017), "End-to-end learning of geometry and context for deep stereo regression", eq.
        1.

    Examples:
        >>> soft_argmax(torch.tensor([[0.0], [0.0], [0.0]]))
        tensor([1.])
    """
    return _expectation(_probabilities(logits))


@check_shapes
def soft_argmax_confidence(logits: Float[Tensor, "*batch N V"]) -> Float[Tensor, "*batch V"]:
    """Return how concentrated the softmax of scores ``(*b, N, V)`` is around its mean, ``(*b, V)``, 0 to 1.

    It is the softmax summed over the four hypotheses around the expectation (fewer at the ends): near 1 for
    one clear peak, small where the distribution is flat or the expectation falls between two peaks.

    References:
        Yao et al. (2018), "MVSNet: depth inference for unstructured multi-view stereo", section 3.3.

    Examples:
        >>> logits = torch.full((8, 1), -20.0)
        >>> logits[3] = 20.0
        >>> soft_argmax_confidence(logits)
        tensor([1.])
    """
    probability = _probabilities(logits)
    is_near_mode = (_index(probability) - _expectation(probability).floor().unsqueeze(-2) - 0.5).abs() < 2
    return (probability * is_near_mode).sum(-2)


def _probabilities(logits: Tensor) -> Tensor:
    """The softmax over hypotheses, in single precision at least: bfloat16 has no number between 150 and 151."""
    return logits.to(torch.promote_types(logits.dtype, torch.float32)).softmax(-2)


def _expectation(probability: Tensor) -> Tensor:
    """The mean index. A product and a sum, which autocast leaves in their precision, unlike a matrix product."""
    return (probability * _index(probability)).sum(-2)


def _index(probability: Tensor) -> Tensor:
    return _hypotheses(probability.shape[-2], probability.dtype, probability.device)


@constant_table
def _hypotheses(number: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.arange(number, dtype=dtype, device=device)[:, None]
