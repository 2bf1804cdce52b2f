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

__all__ = ["FusedLogits", "LogitFusion", "SweepClues", "between_hypotheses", "two_modes"]

REACH = 4
"""Tried hypotheses to each side of the best one that the expectation is taken over."""
PRIOR_FLOOR = -8.0
STRENGTH = 4.0
"""Of the residual, so that layers may be small."""


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
    """

    logits: Float[Tensor, "B M V"]
    state: Float[Tensor, "B S V"]


class LogitFusion(nn.Module):
    """Add costs and a prior as logits, with a gate for each of the two and a residual at every vertex.

    Logits of independent sources add up (a product of experts). A U-Net that sees all clues, the colours and what is up
    says how far to trust each of the two, and what both overlook. Gates begin at one and the residual at zero, so
    training starts from the plain sum: the geometry's precision is there from the first step.

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
        with torch.no_grad():
            self.exit.weight[: num_positions + 2].zero_()
        nn.init.zeros_(self.exit.bias)  # type: ignore[arg-type]
        #: Logarithms of what costs and prior are multiplied with everywhere.
        self.sharpness = nn.Parameter(torch.tensor([math.log(4.0), 0.0]))

    def start(self, clues: SweepClues, prior: Float[Tensor, "B N V"]) -> Float[Tensor, "B V"]:
        """The index ``(B, V)`` that the plain sum of both sources says."""
        cost_weight, prior_weight = self.sharpness.detach().exp()
        return two_modes(prior_weight * between_hypotheses(prior) - cost_weight * clues.cost)[0]

    def forward(
        self,
        clues: SweepClues,
        prior: Float[Tensor, "B N V"],
        start: Float[Tensor, "B V"],
        appearance: AppearanceAtDepth,
        up: Float[Tensor, " V"],
        rig_size: Float[Tensor, " B"],
    ) -> FusedLogits:
        """Return logits and state.

        Args:
            clues: of the sweep.
            prior: ``(B, N, V)`` its logarithms of probabilities at the vertices of the costs.
            start: ``(B, V)`` as the method of that name has it.
            appearance: what cameras see there, K = 1.
            up: ``(V,)`` the upward coordinate of vertices.
            rig_size: ``(B,)`` mean distance of cameras from the centre, in least depths.
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
        prior_clue = prior.clamp(min=PRIOR_FLOOR) / 4
        entries = (clues.cost, clues.best, clues.mean, prior_clue, clues.cameras / 4, color)
        values = self.unet(self.entry(torch.cat((*entries, torch.stack(numbers, 1)), 1)))
        residual, gates, state = self.exit(values).split(self.sizes, 1)
        cost_weight, prior_weight = self._weights(gates)
        logits = prior_weight * between_hypotheses(prior) - cost_weight * clues.cost + STRENGTH * residual
        return FusedLogits(logits, state)

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
    positions = torch.arange(logits.shape[1], device=logits.device)[:, None]

    def far_from_best(scores: Tensor) -> Tensor:
        # argmax takes four times as long as max
        return (positions - scores.max(1, keepdim=True).indices).abs() > REACH

    def expected(far: Tensor) -> Tensor:
        return (logits.masked_fill(far, -torch.inf).softmax(1) * positions).sum(1) / 2

    scores = logits.detach()
    far = far_from_best(scores)
    return expected(far), expected(far_from_best(scores.masked_fill(~far, -torch.inf)))
