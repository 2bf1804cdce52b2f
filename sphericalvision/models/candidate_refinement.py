# SPDX-License-Identifier: Apache-2.0
"""Depth on the next finer icosphere: each vertex chooses between nearby depths by how well the cameras agree there."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from sphericalvision.crown import HexConv2d
from sphericalvision.icosphere import icosphere_upsample, level_from_num_vertices
from sphericalvision.icosphere.hierarchy import icosphere_vertex_parents
from sphericalvision.models.hexunet import HexResidualBlock
from sphericalvision.models.hint_gate import HintedIndex
from sphericalvision.models.logit_fusion import FusedLogits, camera_clue
from sphericalvision.models.tried_hypotheses import tried_index, two_modes
from sphericalvision.sweep.appearance_at_depth import AppearanceAtDepth
from sphericalvision.sweep.ring_mean import vertex_rings

RARE = -4.0
"""Logit of the sky before training."""
PLAUSIBLE = 0.02
"""Weight from which a candidate that was not chosen is the second best answer."""
SHARPENING = 2.0
"""Fall of a logit for each hypothesis of distance from a refined index, up to two."""


class Candidates(NamedTuple):
    """Depths that a vertex may have. Its parents are the two coarser vertices between which it lies.

    Attributes:
        index: ``(B, 4, V)``: mean of the parents, nearest and farthest in the rings around them, and the second best
            index of the first parent, or a hint.
        likely: ``(B, 4, V)`` mean probability of these hypotheses at the parents.
        step: ``(B, V)`` difference of the parents' indices.
        spread: ``(B, V)`` mean of the parents' expected distances from their own index.
    """

    index: Float[Tensor, "B four V"]  # type: ignore[assignment]  # hides tuple.index
    likely: Float[Tensor, "B four V"]
    step: Float[Tensor, "B V"]
    spread: Float[Tensor, "B V"]


class RefinedIndex(NamedTuple):
    """Result of ``CandidateRefinement``.

    Attributes:
        index: ``(B, V)``.
        confidence: ``(B, V)`` logit of the confidence: 1 without an expected error, 0 from two hypotheses on.
        sky: ``(B, V)`` logit of the sky: no surface up to infinity.
        seen: ``(B, V)`` whether two cameras see the point.
        second: ``(B, V)`` the best of the candidates that are a hypothesis or more from the index.
    """

    index: Float[Tensor, "B V"]  # type: ignore[assignment]
    confidence: Float[Tensor, "B V"]
    sky: Float[Tensor, "B V"]
    seen: Bool[Tensor, "B V"]
    second: Float[Tensor, "B V"]


class CandidateRefinement(nn.Module):
    """Choose between ``Candidates``, and correct the choice a little.

    At an edge a mean of depths is the depth of no surface; each side is one. The colours of the cameras agree at the
    right side and differ at the other. Training begins with the mean. The same weights serve at all levels.

    Args:
        state: channels of ``FusedLogits``.
        width: channels of the convolutions.
        blocks: residual blocks.
        details: whether ``forward`` takes finer images around vertices; see ``appearance_around``.

    References:
        Bleyer et al. (2011), "PatchMatch stereo", for candidates from the surroundings; Tankovich et al. (2021),
        "HITNet: hierarchical iterative tile refinement network".
    """

    def __init__(self, state: int, width: int = 16, blocks: int = 1, details: bool = False) -> None:
        super().__init__()
        self.details = HexConv2d(2 * (4 + 3), width, bias=False) if details else None
        if self.details is not None:
            nn.init.zeros_(self.details.weight)
        self.entry = HexConv2d(state + 4 * 4 + 7, width, bias=True)
        self.block = nn.Sequential(*(HexResidualBlock(width) for _ in range(blocks)))
        self.exit = HexConv2d(width, 4 + 3, bias=True)
        with torch.no_grad():
            self.exit.weight.zero_()
            # Of four candidates the mean, the first one, has e³ times the weight of each other.
            self.exit.bias.copy_(torch.tensor([3.0, 0, 0, 0, 0, 0, RARE]))  # type: ignore[union-attr]

    def forward(
        self,
        candidates: Candidates,
        appearance: AppearanceAtDepth,
        state: Float[Tensor, "B S V_coarse"],
        num_hypotheses: int,
        around: Float[Tensor, "B two D V"] | None = None,
    ) -> RefinedIndex:
        """Choose an index ``(B, V)``.

        Args:
            candidates: of ``candidates_of``.
            appearance: of the cameras at each candidate, K = 4.
            state: ``(B, S, V_coarse)`` one level coarser.
            num_hypotheses: N.
            around: ``(B, 2, 7, V)``, ``appearance_around`` at the nearest and at the farthest candidate.
        """
        index, likely, step, spread = candidates
        color, deviation, cameras = appearance
        _, nearest, farthest, _ = color.unbind(1)
        mean = index[:, :1]
        # Factors bring inputs to like sizes. The clamp keeps one far candidate from outweighing all other inputs.
        entries = (
            ((index - mean) / 4).detach().clamp(-2, 2),
            3 * deviation,
            camera_clue(cameras),
            likely,
            color[:, 0],
            (nearest - farthest).abs().mean(1, keepdim=True),
            mean.detach() / num_hypotheses,
            step[:, None] / 4,
            spread[:, None] / 4,
        )
        values = self.entry(torch.cat((icosphere_upsample(state), *entries), 1))
        if self.details is not None:
            if around is None:  # zero times the weights: DDP wants a gradient of each
                values = values + 0 * self.details.weight.sum()
            else:
                deviations, colors = around.split((4, 3), 2)
                values = values + self.details(torch.cat((3 * deviations, colors), 2).flatten(1, 2))
        scores, *others = self.exit(F.relu(self.block(values))).split((4, 1, 1, 1), 1)
        correction, confidence, sky = (values.squeeze(1) for values in others)
        # A weighted mean of the candidates, as the choice of the best one has no gradient.
        weights = scores.softmax(1)
        chosen = ((weights * index).sum(1) + correction).clamp(0, num_hypotheses - 1)
        seen = cameras.gather(1, weights.max(1, keepdim=True).indices).squeeze(1) >= 2
        with torch.no_grad():  # what the next finer level may still choose, where this choice is wrong
            others = weights.masked_fill((index - chosen[:, None]).abs() < 1, -1.0)
            weight, best = others.max(1, keepdim=True)
            second = torch.where(weight > PLAUSIBLE, index.gather(1, best), index[:, 3:]).squeeze(1)
        return RefinedIndex(chosen, confidence, sky, seen, second)


def finer_logits(fused: FusedLogits, index: Float[Tensor, "B V_fine"]) -> FusedLogits:
    """Return logits and state on the next finer icosphere, sharpened around the index that was chosen there.

    Examples:
        >>> fused = FusedLogits(torch.zeros(1, 31, 42), torch.zeros(1, 2, 42))
        >>> finer = finer_logits(fused, torch.full((1, 162), 4.0))
        >>> finer.logits.argmax(1).unique(), finer.state.shape
        (tensor([8]), torch.Size([1, 2, 162]))
    """
    logits = icosphere_upsample(fused.logits)
    distance = (tried_index(logits.shape[1], logits.device) - index.detach()[:, None]).abs().clamp(max=2)
    return FusedLogits(logits.log_softmax(1) - SHARPENING * distance, icosphere_upsample(fused.state))


def candidates_of(
    fused: FusedLogits,
    modes: tuple[Float[Tensor, "B V_coarse"], Float[Tensor, "B V_coarse"]] | None = None,
    hint: HintedIndex | None = None,
) -> Candidates:
    """Return the candidates of the vertices of the next finer icosphere.

    Args:
        fused: logits on the coarser icosphere.
        modes: ``(B, V_coarse)`` best and second best index of its vertices; ``two_modes`` of the logits when not given.
        hint: on the finer icosphere; it replaces the second best index where it is likelier.

    Examples:
        >>> logits = torch.zeros(1, 31, 42)
        >>> logits[:, 8] = 9.0
        >>> index = candidates_of(FusedLogits(logits, torch.zeros(1, 1, 42))).index
        >>> index.shape, [round(value, 2) for value in index[0, :3, 0].tolist()]
        (torch.Size([1, 4, 162]), [4.0, 4.0, 4.0])
    """
    logits = fused.logits
    best, second = two_modes(logits) if modes is None else modes
    level = level_from_num_vertices(logits.shape[-1])
    # Each finer vertex lies half-way between two coarser ones, or on one, which is then both of its parents.
    one, other = icosphere_vertex_parents(level + 1, logits.device).unbind(1)
    around = best[:, vertex_rings(level, logits.device)]
    # The coarse index may place an edge one vertex off: rings around both parents offer the other side, too.
    nearest, farthest = around.amax(-1), around.amin(-1)
    first, last = best[:, one], best[:, other]
    index = torch.stack(
        (
            (first + last) / 2,
            torch.maximum(nearest[:, one], nearest[:, other]),
            torch.minimum(farthest[:, one], farthest[:, other]),
            second[:, one],
            *(() if hint is None else (hint.index,)),
        ),
        1,
    )
    with torch.no_grad():
        probability = logits.softmax(1)
        hypothesis = (2 * index).round().long().clamp(0, logits.shape[1] - 1)
        # Hypotheses and vertices flattened into one dimension: one gather for each parent.
        rows = hypothesis * probability.shape[-1]
        likely = [
            probability.flatten(1).gather(1, (rows + parent).flatten(1)).view_as(index)
            for parent in (one, other)
        ]
        step = (first - last).abs()
        spread = (probability * (tried_index(logits.shape[1], logits.device) - best[:, None]).abs()).sum(1)
        spread = (spread[:, one] + spread[:, other]) / 2
    mean = (likely[0] + likely[1]) / 2
    if hint is not None:  # one of the last two goes, as the layers have inputs for four candidates
        better = ((hint.weight > 0) & (mean[:, 4] >= mean[:, 3]))[:, None]
        index, mean = (
            torch.cat((values[:, :3], values[:, 4:].where(better, values[:, 3:4])), 1)
            for values in (index, mean)
        )
    return Candidates(index, mean, step, spread)
