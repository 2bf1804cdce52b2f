# SPDX-License-Identifier: Apache-2.0
"""Logits of M = 2 N - 1 tried hypotheses: the N, and one between every two of them."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.tables import constant_table

REACH = 4
"""Tried hypotheses to either side of the best one within which the expectation is taken."""


def between_hypotheses(logits: Float[Tensor, "B N V"]) -> Float[Tensor, "B M V"]:
    """Logits ``(B, N, V)`` at the hypotheses and, by their means, between them: ``(B, 2 N - 1, V)``.

    Examples:
        >>> between_hypotheses(torch.tensor([[[1.0], [3.0]]])).flatten()
        tensor([1., 2., 3.])
    """
    means = (logits[:, 1:] + logits[:, :-1]) / 2
    return torch.cat((torch.stack((logits[:, :-1], means), 2).flatten(1, 2), logits[:, -1:]), 1)


@constant_table
def tried_index(number: int, device: torch.device) -> Float[Tensor, "M 1"]:
    """Return the index of each of M = 2 N - 1 tried hypotheses, ``(M, 1)``."""
    return torch.arange(number, device=device)[:, None] / 2


def at_index(values: Float[Tensor, "B M V"], index: Float[Tensor, "B V"]) -> Float[Tensor, "B V"]:
    """Return values ``(B, 2 N - 1, V)`` of tried hypotheses at an index of N, linear between two of them.

    Examples:
        >>> at_index(torch.arange(5.0)[None, :, None], torch.tensor([[1.25]]))
        tensor([[2.5000]])
    """
    position = 2 * index
    lower = position.floor().long().clamp(0, values.shape[1] - 2)
    weight = position - lower
    below, above = (values.gather(1, (lower + step)[:, None]).squeeze(1) for step in (0, 1))
    return below * (1 - weight) + above * weight


def two_modes(logits: Float[Tensor, "B M V"]) -> tuple[Float[Tensor, "B V"], Float[Tensor, "B V"]]:
    """Return the expected indices around the best of M = 2 N - 1 tried hypotheses, and around the best of all others.

    An expectation over all hypotheses lies between two surfaces where either is likely; within two hypotheses of the
    mode it lies on one of them.

    Examples:
        >>> logits = torch.full((1, 31, 1), -30.0)
        >>> logits[0, 8], logits[0, 20] = 3.0, 1.0
        >>> [round(index.item(), 3) for index in two_modes(logits)]
        [4.0, 10.0]
    """
    scores = logits.detach()
    far = _far_from_best(scores)
    others = _far_from_best(scores.masked_fill(~far, -torch.inf))
    return _expected_index(logits, far), _expected_index(logits, others)


def best_mode(logits: Float[Tensor, "B M V"]) -> Float[Tensor, "B V"]:
    """Return the first of ``two_modes``.

    Examples:
        >>> best_mode(torch.tensor([[[-30.0], [3.0], [-30.0]]]))
        tensor([[0.5000]])
    """
    return _expected_index(logits, _far_from_best(logits.detach()))


def _far_from_best(scores: Tensor) -> Tensor:
    index = tried_index(scores.shape[1], scores.device)
    # argmax takes four times as long as max
    return index.sub(scores.max(1, keepdim=True).indices, alpha=0.5).abs() > REACH / 2


def _expected_index(logits: Tensor, far: Tensor) -> Tensor:
    index = tried_index(logits.shape[1], logits.device)
    return (logits.masked_fill(far, -torch.inf).softmax(1) * index).sum(1)
