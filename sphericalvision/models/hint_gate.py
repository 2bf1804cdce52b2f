# SPDX-License-Identifier: Apache-2.0
"""Hints of depth: how far clues of sweep and prior agree with them, and what they change in a fusion's logits."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from sphericalvision.models.tried_hypotheses import at_index, tried_index

HINT_REACH = 4.0
"""Hypotheses beyond which it does not matter how far one is from a hint: it may be wrong."""
HINT_STRENGTH = 3.0
"""By how much a logit falls with each hypothesis of distance from a hint of weight 1, before training."""
HINT_CLUES = 6
"""Channels that say what speaks for and against a hint."""
SURE = 0.9
"""Probability of the answer that the images give, from which on it says something about a hint."""
DISTRUST, TRUST = 0.7, 0.85
"""Agreement of a hint with sure answers up to which it does not count at all, and from which on it counts fully."""
BENEFIT_OF_DOUBT = 0.01
"""Share of the directions by whose number a hint agrees beforehand: where nothing is sure, it is trusted."""
DOUBT_SLOPE, DOUBTFUL_COST = 20.0, 0.7
"""How that share falls with the costs of the hint in the sweep, as a share of the mean over all depths; half there."""


class SweepClues(NamedTuple):
    """What geometry and a learned prior say of every direction: all that ``RefinedSweepNet`` starts from.

    N hypotheses, of which M = 2 N - 1 are tried: one between every two.

    Attributes:
        cost: ``(B, M, V)`` smoothed costs of ``semi_global_costs``, the least of each vertex 0.
        best: ``(B, M, V)`` correlation of the better half of the cameras.
        mean: ``(B, N, V)`` correlation of all cameras that see the point.
        cameras: ``(B, 4, V)`` how many see the point, at four hypotheses from infinity on.
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
    """How far a hint of depth is believed, and by how much it lowers the logits of hypotheses far from it.

    A hint is judged as a whole by what the images say where they are sure (``trust``), and at each vertex by features
    of the fusion (``penalty``). Before training it is the same at all vertices. Without a hint nothing is computed.

    Args:
        width: channels of the fusion's features.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.entry = nn.Conv1d(HINT_CLUES, width, 1, bias=False)
        self.exit = nn.Conv1d(width, 1, 1)
        with torch.no_grad():
            for values in self.parameters():
                values.zero_()

    @staticmethod
    def clues(
        clues: SweepClues, prior: Float[Tensor, "B M V"], start: Float[Tensor, "B V"], hint: HintedIndex
    ) -> Float[Tensor, "B six V"]:
        """Return what speaks for and against a hint ``(B, 6, V)``; 0 where there is none."""
        # One look-up for all three, as at_index costs two gathers each time.
        together = torch.cat((clues.cost, clues.best, prior))
        cost, best, likely = at_index(together, hint.index.repeat(3, 1)).chunk(3)
        difference = ((hint.index - start) / 4).clamp(-2, 2)
        values = (torch.ones_like(cost), difference, cost, clues.cost.mean(1), best, likely / 4)
        return torch.stack(values, 1) * hint.weight[:, None]

    @staticmethod
    def trust(
        hint: HintedIndex,
        hint_clues: Float[Tensor, "B six V"],
        logits: Float[Tensor, "B M V"],
        compared: Bool[Tensor, "B V"],
    ) -> Float[Tensor, "B one"]:
        """Return how far ``(B, 1)`` a hint is believed, by its agreement with the images where they are sure.

        Where they say little it is judged by what they say elsewhere: a right one is believed however bare surfaces
        are. Where they are sure of hardly anything, it is believed if it costs less in the sweep than any depth would.
        """
        count = logits.shape[1]
        positions = tried_index(count, logits.device)
        best = logits.max(1).indices / 2
        # Sure is what has nearly all probability close to its mode, however that is spread there.
        close = (positions - best[:, None]).abs() <= _tolerance(best)[:, None]
        sure = ((logits.softmax(1) * close).sum(1) - SURE).clamp(min=0) / (1 - SURE)
        # Where nothing is sure, agreement is of nothing. A hint of another scene still costs as much as any depth
        # there, a right one clearly less.
        of_hint, of_any = (hint_clues[:, 2:4] * compared[:, None]).sum(-1).unbind(1)
        cheap = (DOUBT_SLOPE * (DOUBTFUL_COST - of_hint / of_any.clamp(min=1e-6))).sigmoid()
        score = agreement(hint, best, sure * compared, count, BENEFIT_OF_DOUBT * cheap)
        return ((score - DISTRUST) / (TRUST - DISTRUST)).clamp(0, 1)[:, None]

    def penalty(
        self, hint: HintedIndex, values: Float[Tensor, "B C V"], count: int
    ) -> Float[Tensor, "B M V"]:
        """Return how much less likely each of ``count`` hypotheses is ``(B, M, V)``, by its distance from a hint."""
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
    """Return how far a hint agrees with an answer, beyond chance: 1 throughout, about 0 for depth of another scene.

    This is Cohen's kappa of being near each other. By chance as many agree as would if the hint's values were dealt out
    to directions at random: in a hall of one depth that is most of them.

    Args:
        hint: to be judged.
        answer: index without it.
        sure: weight of each direction, 0 to 1.
        tried: M = 2 N - 1 hypotheses.
        granted: share of the directions that agree beforehand, of ``BENEFIT_OF_DOUBT``.

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
    """Hypotheses that are near an index; those of near things are told from each other less well."""
    return 0.75 + 0.1 * index
