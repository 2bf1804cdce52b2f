# SPDX-License-Identifier: Apache-2.0
"""Fusion of two sources of logits, the costs of a sweep and a learned prior, by learned gates."""

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
"""Log probability at which the prior is cut before it enters the layers: a third of a thousandth."""
STRENGTH = 4.0
"""Factor of the residual, so that the weights of its layer stay small."""
MAX_CAMERAS = 6
"""Cameras of the largest rigs in training; more count as these. Uncut, twenty cameras make the error a third larger."""


class FusedLogits(NamedTuple):
    """Result of ``LogitFusion``.

    Attributes:
        logits: ``(B, M, V)`` of tried hypotheses.
        state: ``(B, S, V)`` features for the refinement.
        trust: ``(B, 1)`` in the hint, 0 to 1; None without one.
    """

    logits: Float[Tensor, "B M V"]
    state: Float[Tensor, "B S V"]
    trust: Float[Tensor, "B one"] | None = None


def camera_clue(cameras: Tensor) -> Tensor:
    """Return the number of cameras that see a point as an input of layers, at most that of ``MAX_CAMERAS``."""
    return cameras.clamp(max=MAX_CAMERAS) / 4


class LogitFusion(nn.Module):
    """Add costs and a prior as logits, with a gate for each of the two and a residual at every vertex.

    Logits of independent sources add up (a product of experts). From all clues, the colours and the upward direction a
    U-Net computes gates, how far to trust each source, and a residual for what both miss. Gates begin at one and the
    residual at zero: training starts from the plain sum, with the precision of the geometry. A hint is a third source
    with layers of its own, which do not run without one.

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
        #: Logarithms of the factors of costs and prior at all vertices.
        self.sharpness = nn.Parameter(torch.tensor([math.log(4.0), 0.0]))

    def start(self, clues: SweepClues, prior: Float[Tensor, "B M V"]) -> Float[Tensor, "B V"]:
        """Return the index ``(B, V)`` of the plain sum of both sources, without gates; arguments as of ``forward``."""
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
            prior: ``(B, M, V)`` log probabilities at the vertices and tried hypotheses of the costs.
            start: ``(B, V)``, result of the method ``start``.
            appearance: of the cameras at ``start``, K = 1.
            up: ``(V,)`` the upward coordinate of vertices.
            rig_size: ``(B,)`` mean distance of the cameras from the centre, in units of ``min_depth``.
            hint: at the vertices of the costs.
        """
        number = clues.mean.shape[1]
        color, deviation, cameras = (values[:, 0] for values in appearance)
        ones = torch.ones_like(start)
        # Here and in ``entries`` factors bring inputs to like sizes: all begin with weights of one size.
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
        values = self.unet(values)
        residual, gates, state = self.exit(values).split(self.sizes, 1)
        cost_weight, prior_weight = self._weights(gates)
        logits = prior_weight * prior - cost_weight * clues.cost + STRENGTH * residual
        if hint is None:
            return FusedLogits(logits, state)
        # The images judge the hint: by logits before it enters them, and only where two cameras see the point.
        trust = self.hint_gate.trust(hint, clues.cost, logits.detach(), clues.cameras.amax(1) >= 2)
        penalty = self.hint_gate.penalty(hint.trusted(trust), values, self.sizes[0])
        return FusedLogits(logits - penalty, state, trust)

    def _weights(self, gates: Tensor) -> tuple[Tensor, ...]:
        """Factors ``(B, 1, V)`` of costs and prior from gates ``(B, 2, V)``."""
        # A gate changes a factor by e³ = 20 times at most; ``exp`` of large gates would be infinite.
        return (self.sharpness[:, None] + gates.clamp(-3, 3)).exp().split(1, 1)
