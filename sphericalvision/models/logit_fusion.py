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
from sphericalvision.models.hint_gate import HintedIndex, HintGate, SweepClues
from sphericalvision.models.tried_hypotheses import best_mode
from sphericalvision.sweep.appearance_at_depth import AppearanceAtDepth

PRIOR_FLOOR = -8.0
"""Logarithm of a probability below which layers need not tell hypotheses apart: a third of a thousandth."""
STRENGTH = 4.0
"""Of the residual, so that layers may be small."""
MAX_CAMERAS = 6
"""Cameras of the largest rigs in training. Layers never met larger counts: with twenty the error is a third larger."""


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


def camera_clue(cameras: Tensor) -> Tensor:
    """Return how many cameras see a point as layers take it: a rig of many is to them one of ``MAX_CAMERAS``."""
    return cameras.clamp(max=MAX_CAMERAS) / 4


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
        self.hint_gate = HintGate(widths[0])
        with torch.no_grad():
            self.exit.weight[: num_positions + 2].zero_()
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
        # Here and in ``entries`` factors bring clues to like sizes: layers begin with weights of one size for all.
        numbers = (
            start / number,
            2 * deviation,
            camera_clue(cameras),
            up * ones,
            rig_size.clamp(max=2)[:, None] * ones,
            2 * color.mean(1).abs(),
        )
        prior_clue = prior[:, ::2].clamp(min=PRIOR_FLOOR) / 4
        entries = (clues.cost, clues.best, clues.mean, prior_clue, camera_clue(clues.cameras), color)
        values = self.entry(torch.cat((*entries, torch.stack(numbers, 1)), 1))
        if hint is not None:
            hint_clues = self.hint_gate.clues(clues, prior, start, hint)
            values = values + self.hint_gate.entry(hint_clues)
        values = self.unet(values)
        residual, gates, state = self.exit(values).split(self.sizes, 1)
        cost_weight, prior_weight = self._weights(gates)
        logits = prior_weight * prior - cost_weight * clues.cost + STRENGTH * residual
        if hint is None:
            return FusedLogits(logits, state)
        # Judged by the logits before the hint is in them, and where two cameras can compare.
        trust = self.hint_gate.trust(hint, hint_clues, logits.detach(), clues.cameras.amax(1) >= 2)
        penalty = self.hint_gate.penalty(hint.trusted(trust), values, self.sizes[0])
        return FusedLogits(logits - penalty, state, trust)

    def _weights(self, gates: Tensor) -> tuple[Tensor, ...]:
        """Factors ``(B, 1, V)`` of costs and prior from gates ``(B, 2, V)``."""
        # A gate changes a factor by 20 times at most, or ``exp`` would make infinities of large gates.
        return (self.sharpness[:, None] + gates.clamp(-3, 3)).exp().split(1, 1)
