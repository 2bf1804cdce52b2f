# SPDX-License-Identifier: Apache-2.0
"""Logits of hypotheses from two sources, costs of a sweep and a learned prior, added with learned gates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sphericalvision.models.hexunet import HexUNet
from sphericalvision.sweep.appearance_at_depth import AppearanceAtDepth
from sphericalvision.tables import constant_table

__all__ = [
    "FusedLogits",
    "HintedIndex",
    "LogitFusion",
    "SweepClues",
    "agreement",
    "at_index",
    "best_mode",
    "between_hypotheses",
    "tried_index",
    "two_modes",
]

REACH = 4
"""Tried hypotheses to each side of the best one that the expectation is taken over."""
PRIOR_FLOOR = -8.0
STRENGTH = 4.0
"""Of the residual, so that layers may be small."""
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


class FusedLogits(NamedTuple):
    """What ``LogitFusion`` makes of clues.

    Attributes:
        logits: ``(B, M, V)`` of tried hypotheses.
        state: ``(B, S, V)`` features for whoever refines them.
        trust: ``(B, 1)`` in a hint, 0 to 1; None for none.
    """

    logits: Float[Tensor, "B M V"]
    state: Float[Tensor, "B S V"]
    trust: Float[Tensor, "B one"] | None = None


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


class LogitFusion(nn.Module):
    """Add costs and a prior as logits, with a gate for each of the two and a residual at every vertex.

    Logits of independent sources add up (a product of experts). A U-Net that sees all clues, the colours and what is up
    says how far to trust each of the two, and what both overlook. Gates begin at one and the residual at zero, so
    training starts from the plain sum: the geometry's precision is there from the first step. A hint, where there is
    one, is a third source, with layers of its own: without it nothing is computed for it.

    Args:
        num_hypotheses: N.
        widths: channels of the U-Net, see ``HexUNet``.
        state: channels handed on.
        blocks: of the U-Net.

    References:
        Hinton (2002), "Training products of experts by minimizing contrastive divergence"; Seki and Pollefeys
        (2017), "SGM-Nets: semi-global matching with neural networks".
    """

    def __init__(
        self, num_hypotheses: int, widths: tuple[int, ...], state: int, blocks: int | Sequence[int] = 1
    ) -> None:
        super().__init__()
        num_positions = 2 * num_hypotheses - 1
        self.sizes = (num_positions, 2, state)
        self.entry = nn.Conv1d(2 * num_positions + 2 * num_hypotheses + 4 + 3 + 6, widths[0], 1)
        self.unet = HexUNet(widths, blocks)
        self.exit = nn.Conv1d(widths[0], sum(self.sizes), 1)
        self.hint_entry = nn.Conv1d(HINT_CLUES, widths[0], 1, bias=False)
        self.hint_exit = nn.Conv1d(widths[0], 1, 1)
        with torch.no_grad():
            self.exit.weight[: num_positions + 2].zero_()
            for values in (*self.hint_entry.parameters(), *self.hint_exit.parameters()):
                values.zero_()
        nn.init.zeros_(self.exit.bias)  # type: ignore[arg-type]
        #: Logarithms of what costs and prior are multiplied with everywhere.
        self.sharpness = nn.Parameter(torch.tensor([math.log(4.0), 0.0]))

    def start(self, clues: SweepClues, prior: Float[Tensor, "B M V"]) -> Float[Tensor, "B V"]:
        """The index ``(B, V)`` that the plain sum of both sources says; arguments as of ``forward``."""
        cost_weight, prior_weight = self.sharpness.detach().exp()
        return best_mode(prior_weight * prior - cost_weight * clues.cost)

    def forward(
        self,
        clues: SweepClues,
        prior: Float[Tensor, "B M V"],
        start: Float[Tensor, "B V"],
        appearance: AppearanceAtDepth,
        up: Float[Tensor, " V"],
        rig_size: Float[Tensor, " B"],
        hint: HintedIndex | None = None,
    ) -> FusedLogits:
        """Return logits and state.

        Args:
            clues: of the sweep.
            prior: ``(B, M, V)`` its logarithms of probabilities, at the costs' vertices and ``between_hypotheses``.
            start: ``(B, V)`` as the method of that name has it.
            appearance: what cameras see there, K = 1.
            up: ``(V,)`` the upward coordinate of vertices.
            rig_size: ``(B,)`` mean distance of cameras from the centre, in least depths.
            hint: at the vertices of the costs.
        """
        number = clues.mean.shape[1]
        color, deviation, cameras = (values[:, 0] for values in appearance)
        ones = torch.ones_like(start)
        numbers = (
            start / number,
            2 * deviation,
            cameras / 4,
            up * ones,
            rig_size.clamp(max=2)[:, None] * ones,
            2 * color.mean(1).abs(),
        )
        prior_clue = prior[:, ::2].clamp(min=PRIOR_FLOOR) / 4
        entries = (clues.cost, clues.best, clues.mean, prior_clue, clues.cameras / 4, color)
        values = self.entry(torch.cat((*entries, torch.stack(numbers, 1)), 1))
        if hint is not None:
            hint_clues = self._hint_clues(clues, prior, start, hint)
            values = values + self.hint_entry(hint_clues)
        values = self.unet(values)
        residual, gates, state = self.exit(values).split(self.sizes, 1)
        cost_weight, prior_weight = self._weights(gates)
        logits = prior_weight * prior - cost_weight * clues.cost + STRENGTH * residual
        if hint is None:
            return FusedLogits(logits, state)
        trust = self._trust(hint, hint_clues, logits.detach(), clues.cameras.amax(1) >= 2)
        return FusedLogits(logits - self._hint_distance(hint.trusted(trust), values), state, trust)

    @staticmethod
    def _hint_clues(clues: SweepClues, prior: Tensor, start: Tensor, hint: HintedIndex) -> Tensor:
        """What speaks for and against a hint ``(B, 6, V)``; 0 where there is none."""
        together = torch.cat((clues.cost, clues.best, prior))
        cost, best, likely = at_index(together, hint.index.repeat(3, 1)).chunk(3)
        difference = ((hint.index - start) / 4).clamp(-2, 2)
        values = (torch.ones_like(cost), difference, cost, clues.cost.mean(1), best, likely / 4)
        return torch.stack(values, 1) * hint.weight[:, None]

    def _trust(self, hint: HintedIndex, hint_clues: Tensor, logits: Tensor, compared: Tensor) -> Tensor:
        """How far ``(B, 1)`` a hint is to be believed, by its agreement with what the images say where they are sure.

        Where they say little it is judged by what they say elsewhere: a right one is believed however bare surfaces
        are. Where they are sure of hardly anything, it is believed if it costs less in the sweep than any depth would.
        """
        positions = tried_index(self.sizes[0], logits.device)
        best = logits.max(1).indices / 2
        near = (positions - best[:, None]).abs() <= _tolerance(best)[:, None]
        sure = ((logits.softmax(1) * near).sum(1) - SURE).clamp(min=0) / (1 - SURE)
        of_hint, of_any = (hint_clues[:, 2:4] * compared[:, None]).sum(-1).unbind(1)
        cheap = (DOUBT_SLOPE * (DOUBTFUL_COST - of_hint / of_any.clamp(min=1e-6))).sigmoid()
        score = agreement(hint, best, sure * compared, self.sizes[0], BENEFIT_OF_DOUBT * cheap)
        return ((score - DISTRUST) / (TRUST - DISTRUST)).clamp(0, 1)[:, None]

    def _hint_distance(self, hint: HintedIndex, values: Tensor) -> Tensor:
        """By how much each hypothesis ``(B, M, V)`` is less likely the farther it is from a hint."""
        distance = (
            (tried_index(self.sizes[0], values.device) - hint.index[:, None]).abs().clamp(max=HINT_REACH)
        )
        gate = self.hint_exit(values).clamp(-3, 3).exp()
        return HINT_STRENGTH * hint.weight[:, None] * gate * distance

    def _weights(self, gates: Tensor) -> tuple[Tensor, ...]:
        """Factors ``(B, 1, V)`` of costs and prior from gates ``(B, 2, V)``."""
        return (self.sharpness[:, None] + gates.clamp(-3, 3)).exp().split(1, 1)


def between_hypotheses(logits: Float[Tensor, "B N V"]) -> Float[Tensor, "B M V"]:
    """Logits ``(B, N, V)`` at the hypotheses and, by their means, between them: ``(B, 2 N - 1, V)``.

    Examples:
        >>> between_hypotheses(torch.tensor([[[1.0], [3.0]]])).flatten()
        tensor([1., 2., 3.])
    """
    middle = (logits[:, 1:] + logits[:, :-1]) / 2
    return torch.cat((torch.stack((logits[:, :-1], middle), 2).flatten(1, 2), logits[:, -1:]), 1)


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
    place = 2 * index
    lower = place.floor().long().clamp(0, values.shape[1] - 2)
    share = place - lower
    below, above = (values.gather(1, (lower + step)[:, None]).squeeze(1) for step in (0, 1))
    return below * (1 - share) + above * share


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
    near = ((hint.index - answer).abs() <= tolerance).to(answer.dtype)
    agreed, possible = ((counted * (values - chance)).mean(-1) for values in (near, 1))
    return (agreed + granted) / (possible + BENEFIT_OF_DOUBT)


def _tolerance(index: Tensor) -> Tensor:
    """Hypotheses that are near an index; those of near things are told from each other less well."""
    return 0.75 + 0.1 * index


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
