# SPDX-License-Identifier: Apache-2.0
"""Hints of depth: how far the images agree with one, and the penalty it adds to the logits of the fusion."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from sphericalvision.models.tried_hypotheses import at_index, tried_index

HINT_REACH = 4.0
"""Hypotheses of distance from a hint beyond which the penalty stays the same, as the hint may be wrong."""
HINT_STRENGTH = 3.0
"""Fall of a logit for each hypothesis of distance from a hint of weight 1, before training."""
SURE = 0.98
"""Probability around the best hypothesis above which a vertex is sure enough to judge a hint."""
DISTRUST, TRUST = 0.75, 0.9
"""Agreement with sure vertices at which the trust in a hint begins to rise from 0, and at which it reaches 1."""
BENEFIT_OF_DOUBT = 0.01
"""Agreement granted beforehand, as a share of the directions: where nothing is sure, a hint is trusted."""
DOUBT_SLOPE, DOUBTFUL_COST = 20.0, 0.8
"""The granted share is halved where a hint costs 0.8 of the mean over all depths, and falls with this slope.

These five were chosen among 135 settings on 33 rendered captures of five kinds of scenes: all right hints, 5 to 10 %
off or sparse, are trusted, and of wrong ones 9 % of those that are another scene's depth, 1.4 times as near or turned.
"""


class SweepClues(NamedTuple):
    """Results of the sweep and the learned prior, from which ``RefinedSweepNet`` starts.

    M = 2 N - 1 hypotheses are tried: the N, and one between every two.

    Attributes:
        cost: ``(B, M, V)`` smoothed costs of ``semi_global_costs``, the least of each vertex 0.
        best: ``(B, M, V)`` correlation of the better half of the cameras.
        mean: ``(B, N, V)`` correlation of all cameras that see the point.
        cameras: ``(B, 4, V)`` number that see the point, at four hypotheses from infinity to the nearest.
        prior: ``(B, N, V_prior)`` logits, on this or a coarser icosphere.
    """

    cost: Float[Tensor, "B M V"]
    best: Float[Tensor, "B M V"]
    mean: Float[Tensor, "B N V"]
    cameras: Float[Tensor, "B four V"]
    prior: Float[Tensor, "B N V_prior"]


class HintedIndex(NamedTuple):
    """A ``DepthHint`` in hypotheses.

    Attributes:
        index: ``(B, V)``, 0 to N - 1.
        weight: ``(B, V)`` 0 to 1; 0 where nothing is known.
    """

    index: Float[Tensor, "B V"]  # type: ignore[assignment]  # hides tuple.index
    weight: Float[Tensor, "B V"]

    def trusted(self, trust: Float[Tensor, "B one"]) -> HintedIndex:
        """Return the hint with its weight multiplied."""
        return HintedIndex(self.index, self.weight * trust)


class HintGate(nn.Module):
    """Trust in a hint of depth, and the penalty of hypotheses far from it.

    The trust is one number, from the agreement of the hint with the images where these are sure. The penalty is learned
    at each vertex from features of the fusion, which know nothing of the hint; before training it is the same at all
    vertices. A hint that is not trusted changes nothing.

    Args:
        width: channels of the fusion's features.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.exit = nn.Conv1d(width, 1, 1)
        with torch.no_grad():
            for values in self.parameters():
                values.zero_()

    @staticmethod
    def trust(
        hint: HintedIndex,
        cost: Float[Tensor, "B M V"],
        logits: Float[Tensor, "B M V"],
        compared: Bool[Tensor, "B V"],
    ) -> Float[Tensor, "B one"]:
        """Return the trust ``(B, 1)``, from the agreement of the hint with the images where these are sure.

        The sure vertices judge for all: a right hint is trusted on bare surfaces, too. Where hardly any vertex is sure,
        a hint is trusted if it costs less in the sweep than the mean over all depths.
        """
        count = logits.shape[1]
        positions = tried_index(count, logits.device)
        best = logits.max(1).indices / 2
        # A vertex is sure if nearly all probability is close to the best hypothesis, however it is spread there.
        close = (positions - best[:, None]).abs() <= _tolerance(best)[:, None]
        sure = ((logits.softmax(1) * close).sum(1) - SURE).clamp(min=0) / (1 - SURE)
        # Without sure vertices there is nothing to agree with. Costs still tell: a hint of another scene costs as much
        # as any depth, a right one clearly less.
        counted = hint.weight * compared
        of_hint, of_any = (
            (values * counted).sum(-1) for values in (at_index(cost, hint.index), cost.mean(1))
        )
        cheap = (DOUBT_SLOPE * (DOUBTFUL_COST - of_hint / of_any.clamp(min=1e-6))).sigmoid()
        score = agreement(hint, best, sure * compared, count, BENEFIT_OF_DOUBT * cheap)
        return ((score - DISTRUST) / (TRUST - DISTRUST)).clamp(0, 1)[:, None]

    def penalty(
        self, hint: HintedIndex, values: Float[Tensor, "B C V"], count: int
    ) -> Float[Tensor, "B M V"]:
        """Return the penalty ``(B, M, V)`` of each of ``count`` tried hypotheses, by its distance from the hint."""
        distance = (tried_index(count, values.device) - hint.index[:, None]).abs().clamp(max=HINT_REACH)
        gate = self.exit(values).clamp(-3, 3).exp()
        return HINT_STRENGTH * hint.weight[:, None] * gate * distance


def agreement(
    hint: HintedIndex,
    answer: Float[Tensor, "B V"],
    sure: Float[Tensor, "B V"],
    tried: int,
    granted: Float[Tensor, " B"] | float = BENEFIT_OF_DOUBT,
) -> Float[Tensor, " B"]:
    """Return the agreement of a hint with an answer beyond chance: 1 if all agree, about 0 for another scene's depth.

    This is Cohen's kappa, where to agree is to be within a tolerance. Chance is the agreement of the hint's values
    assigned to directions at random: in a hall of one depth it is nearly complete.

    Args:
        hint: the hint.
        answer: index without it.
        sure: weight of each direction, 0 to 1.
        tried: M = 2 N - 1 hypotheses.
        granted: share of the directions counted as agreeing beforehand, 0 to ``BENEFIT_OF_DOUBT``.

    References:
        Cohen (1960), "A coefficient of agreement for nominal scales".

    Examples:
        >>> answer = torch.linspace(0, 15, 1000)[None]
        >>> ones = torch.ones_like(answer)
        >>> hints = [HintedIndex(index, ones) for index in (answer + 0.2, 15 * ones)]
        >>> [round(agreement(hint, answer, ones, 31).item(), 1) for hint in hints]
        [1.0, 0.0]
    """
    positions = tried_index(tried, answer.device)
    tolerance = _tolerance(answer)
    counted = sure * (hint.weight > 0)
    dealt = ((1 - 2 * (positions - hint.index[:, None]).abs()).clamp(min=0) * counted[:, None]).sum(-1)
    dealt = dealt / counted.sum(-1, keepdim=True).clamp(min=1e-6)
    chance = (dealt[..., None] * ((positions - answer[:, None]).abs() <= tolerance[:, None])).sum(1)
    agrees = ((hint.index - answer).abs() <= tolerance).to(answer.dtype)
    agreed, possible = ((counted * (values - chance)).mean(-1) for values in (agrees, 1))
    return (agreed + granted) / (possible + BENEFIT_OF_DOUBT)


def _tolerance(index: Tensor) -> Tensor:
    """Tolerance in hypotheses; near depths are told apart less well."""
    return 0.75 + 0.1 * index
