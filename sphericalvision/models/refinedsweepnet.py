# SPDX-License-Identifier: Apache-2.0
"""RefinedSweepNet: depth from a semi-global sweep, which a network corrects and refines."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from sphericalvision.core import ArgumentError
from sphericalvision.icosphere import (
    Icosphere,
    icosphere_upsample,
    icosphere_vertices,
    level_from_num_vertices,
)
from sphericalvision.icosphere.topology import check_level
from sphericalvision.losses.depth_loss import mean_of_samples
from sphericalvision.models.candidate_refinement import (
    CandidateRefinement,
    RefinedIndex,
    candidates_of,
    finer_logits,
)
from sphericalvision.models.depth_network import DepthNetwork
from sphericalvision.models.hint_gate import HintedIndex, SweepClues
from sphericalvision.models.icosweepnet import IcoSweepNet
from sphericalvision.models.logit_fusion import FusedLogits, LogitFusion
from sphericalvision.models.tried_hypotheses import at_index, between_hypotheses, tried_index, two_modes
from sphericalvision.models.weights.registry import register_network
from sphericalvision.sweep import (
    DepthEstimate,
    DepthHint,
    SweepTables,
    index_from_inverse_depth,
    inverse_depth_from_index,
    semi_global_costs,
    semi_global_tables,
)
from sphericalvision.sweep.appearance_at_depth import (
    AppearanceAtDepth,
    appearance_around,
    appearance_at_depth,
)
from sphericalvision.sweep.ring_mean import coarser_images, ids_of_coarser_level, vertex_rings
from sphericalvision.sweep.semi_global import SemiGlobalTables, check_tables
from sphericalvision.sweep.visibility import check_seen, seen_in_view
from sphericalvision.tables import constant_table

if TYPE_CHECKING:
    from sphericalvision.cameras import CameraRig

STATE = 12
"""Channels that fusion hands to refinement."""
PRIOR = {
    "feature_channels": 16,
    "norm": "instance",
    "aggregation": "variance",
    "feature_coarsening": 1,
    "volume_channels": 8,
}
"""Hyper-parameters of ``icosweepnet-small`` that its weights depend on."""
SCALES = ("level", "num_hypotheses", "min_depth")
"""Hyper-parameters of the prior that the network around it sets."""
DOUBTFUL = 2.0
"""Error in hypotheses at which the confidence should be 0."""
FARTHEST = 0.06
"""Least index of a surface, at 250 times ``min_depth``: farther than any rig tells from infinity."""
PRIOR_SHARE = 0.1
"""Weight of the prior's own cross entropy in the loss."""
ENTROPY_SHARE, EXPECTED_ERROR_SHARE = 0.1, 0.1
"""Weights of the fused logits' cross entropy and of their expected error. The index is an expectation around the best
mode, so its error has no gradient for other modes; these two have."""
EDGE_WEIGHT = 2.0
"""Additional weight in the loss of a vertex whose ring spans more than one hypothesis."""
RARE_SKY, MOST = 0.05, 4.0
"""Sky on less than this share of the sphere gets the weight of that share in the loss, up to a factor of ``MOST``."""


class RefinedTables(NamedTuple):
    """Tables of a rig for ``RefinedSweepNet``.

    Attributes:
        sweep: of the semi-global sweep.
        prior: of the learned prior's sweep.
        offsets: ``([B,] n, 3)`` from each camera to the rig's centre, metres.
        seen: ``([B,] n, V_image)`` True in the fields of view and masks.
    """

    sweep: SemiGlobalTables
    prior: SweepTables
    offsets: Float[Tensor, "*batch n 3"]
    seen: Bool[Tensor, "*batch n V_image"]

    def to(self, device: torch.device | str) -> RefinedTables:
        """Return the tables on another device."""
        fields = (self.sweep, self.prior, self.offsets, self.seen)
        return RefinedTables(*(part.to(device) for part in fields))  # type: ignore[arg-type]


class RefinedSweepNet(DepthNetwork):
    """Depth of any rig at the level of its images: a semi-global sweep and a learned prior, fused and refined.

    ==========  ==========================  ===============================================================
    stage       level                       what it does
    ==========  ==========================  ===============================================================
    clues       coarse_level                costs of ``semi_global_costs``; logits of an ``IcoSweepNet``, the prior
    fusion      coarse_level                both added as logits, with gates and a residual: ``LogitFusion``
    refinement  coarse_level + 1 to level   a choice between the depths around each vertex: ``CandidateRefinement``
    ==========  ==========================  ===============================================================

    Clues and fusion take the images averaged down to ``coarse_level + 1``, each refining step at its own level.
    All steps share their weights, so ``level`` may be raised after training: that adds steps, but no finer sweep.

    The sweep is accurate where there is texture, and the prior has learned scenes where there is none. The network
    takes two or more cameras in any order, tilted or not, with partial coverage, or panoramas.

    Args:
        level: of the icospheres that hold the images and the result, as many as there are widths or more.
        num_hypotheses: N of the resulting index.
        min_depth: radius of the nearest hypothesis in metres.
        inner_hypotheses: hypotheses inside the network, whatever N is.
        prior: hyper-parameters of the ``IcoSweepNet``; those of ``icosweepnet-small`` when not given.
        widths: channels of the fusion's U-Net at each level, from ``coarse_level`` on.
        blocks: residual blocks of the U-Net, one number or one a level.
        refining_blocks: residual blocks of the refinement.
        coarse_level: of clues and fusion, at most ``level - 1``, which it is when not given.
        details: whether each step of the refinement takes images one level finer at boundaries, if there are any;
            ``image_level`` is then ``level + 1``.

    Raises:
        ArgumentError: for no widths, or a level, or ``coarse_level + 1``, below their number.

    References:
        Komatsu et al. (2020), "360° depth estimation from multiple fisheye images with origami crown representation
        of icosahedron"; Hirschmüller (2008), "Stereo processing by semiglobal matching and mutual information".

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> net = RefinedSweepNet(level=5).eval()
        >>> with torch.inference_mode():
        ...     net(torch.zeros(1, 3, 3, 10242), ring_rig(3)).shape
        torch.Size([1, 10242])
    """

    min_depth_follows = "training"
    takes_hints = True
    up: Tensor

    def __init__(
        self,
        level: int = 6,
        num_hypotheses: int = 16,
        min_depth: float = 0.55,
        inner_hypotheses: int = 16,
        prior: Mapping[str, Any] | None = None,
        widths: Sequence[int] = (32, 48, 64, 96, 96),
        blocks: int | Sequence[int] = (1, 2, 2, 3, 3),
        refining_blocks: int = 2,
        coarse_level: int | None = None,
        details: bool = False,
    ) -> None:
        if not widths:
            raise ArgumentError("widths: expected the channels of one level or more, got none")
        if check_level(level) < len(widths):
            raise ArgumentError(
                f"level: expected {len(widths)} or more, got {level!r}: this network looks at its images on "
                f"{len(widths)} icospheres, each a level coarser; take level={len(widths)}, another network such as "
                "icosweepnet-small, or method=semi_global"
            )
        if coarse_level is not None and check_level(coarse_level) + 1 < len(widths):
            raise ArgumentError(
                f"coarse_level: expected {len(widths) - 1} or more for {len(widths)} widths, got {coarse_level!r}"
            )
        super().__init__(num_hypotheses, min_depth, num_cameras=2, any_cameras=True)
        self.coarse_level = level - 1 if coarse_level is None else min(coarse_level, level - 1)
        self.level, self.grid, self.inner_hypotheses = level, Icosphere(level), inner_hypotheses
        scale = {"level": self.coarse_level + 1, "num_hypotheses": inner_hypotheses, "min_depth": min_depth}
        self.prior = IcoSweepNet(**{**(PRIOR if prior is None else prior), **scale})
        self.fusion = LogitFusion(inner_hypotheses, tuple(widths), STATE, blocks)
        self.refinement = CandidateRefinement(STATE, blocks=refining_blocks, details=details)
        self.register_buffer("up", -icosphere_vertices(self.coarse_level)[:, 1], persistent=False)

    @classmethod
    def around(cls, prior: IcoSweepNet, train_prior: bool = False, **hyperparameters: Any) -> Self:
        """Return an untrained network around a trained prior.

        Args:
            prior: for instance ``pretrained("icosweepnet-small")``.
            train_prior: whether the prior learns, too, at about twice the cost of a step; else it stays as it is.
            hyperparameters: of the class, but ``prior``.

        Examples:
            >>> from sphericalvision.models import pretrained
            >>> net = RefinedSweepNet.around(pretrained("icosweepnet-small"), level=5)
            >>> any(parameter.requires_grad for parameter in net.prior.parameters())
            False
        """
        if not isinstance(prior, IcoSweepNet):
            raise ArgumentError(f"prior: expected an IcoSweepNet, got {type(prior).__name__}")
        shape = {name: value for name, value in prior.hyperparameters.items() if name not in SCALES}
        net = cls(**hyperparameters, prior=shape)
        net.prior.load_state_dict(prior.state_dict())
        net.prior.requires_grad_(train_prior)
        return net

    @property
    def image_level(self) -> int:
        """Level of the finest images that this network uses; it also takes images of ``level``."""
        return self.level + (self.refinement.details is not None)

    def tables(self, rig: CameraRig) -> RefinedTables:
        """Return the tables of a rig, which may be passed in its place."""
        rig = rig.to(self.device)
        sweep = semi_global_tables(rig, self.inner_hypotheses, self.min_depth, self.coarse_level + 1)
        seen = (
            sweep.seen if self.image_level == self.coarse_level + 1 else seen_in_view(rig, self.image_level)
        )
        return RefinedTables(
            sweep, self.prior.tables(rig), _offsets(rig).to(self.up), seen.to(sweep.seen.device)
        )

    def _estimate(
        self, images: Tensor, rig: CameraRig | RefinedTables, seen: Tensor | None, hint: DepthHint | None
    ) -> DepthEstimate:
        return self._estimate_and_trust(images, rig, seen, hint)[0]

    def _estimate_and_trust(
        self, images: Tensor, rig: CameraRig | RefinedTables, seen: Tensor | None, hint: DepthHint | None
    ) -> tuple[DepthEstimate, Tensor | None]:
        tables = rig if isinstance(rig, RefinedTables) else self.tables(rig)
        seen_in_views = self._seen(tables, images)
        views = self.views(images, seen_in_views if seen is None else seen)
        coarse, coarse_seen = views[0]
        clues = self.clues(coarse, tables, coarse_seen)
        hints = self.hints(hint)
        fused = self.fuse(clues, coarse, coarse_seen, tables.offsets, hints[0])
        index, confidence, sky, seen_by_two, _ = self.refinements(fused, views, tables.offsets, hints[1:])[-1]
        # Sky is at infinity, index 0. A surface is not: an index of nearly 0 would be a depth of kilometres.
        index = index.clamp(min=FARTHEST).masked_fill(sky >= 0, 0.0)
        scale = (self.num_hypotheses - 1) / (self.inner_hypotheses - 1)
        confidence = confidence.sigmoid().masked_fill(~seen_by_two, 0.0)
        return DepthEstimate(index * scale, confidence, seen_by_two), fused.trust

    def views(
        self,
        images: Float[Tensor, "B n 3 V_image"],
        seen: Bool[Tensor, "B n V_image"] | Bool[Tensor, "n V_image"],
    ) -> list[tuple[Tensor, Tensor]]:
        """Return the images and their ``seen`` at each level from ``coarse_level + 1`` to their own."""
        views = [(images, check_seen(seen, images))]
        for _ in range(self.coarse_level + 1, level_from_num_vertices(images.shape[-1])):
            views.insert(0, coarser_images(*views[0]))
        return views

    def _seen(self, tables: RefinedTables, images: Tensor) -> Tensor:
        """``seen`` of tables for images of ``level`` or ``image_level``; ``ShapeError`` for others."""
        if self.image_level > self.level and images.shape[-1] == self.grid.num_vertices:
            ids = ids_of_coarser_level(self.image_level, self.level, images.device)
            return tables.seen.index_select(-1, ids)
        check_tables(tables.seen, images)
        return tables.seen

    def hints(self, hint: DepthHint | None) -> list[HintedIndex] | list[None]:
        """Return the hint in inner hypotheses at each level from ``coarse_level`` to ``level``; None for no hint."""
        if hint is None:
            return [None] * (self.level - self.coarse_level + 1)
        hints = [DepthHint(*(values.to(self.up) for values in hint))]  # of numpy they are float64
        for _ in range(self.coarse_level, self.level):
            hints.insert(0, hints[0].coarser())
        scale = self.inner_hypotheses, self.min_depth
        return [
            HintedIndex(index_from_inverse_depth(inverse_depth, *scale).clamp(max=scale[0] - 1), weight)
            for inverse_depth, weight in hints
        ]

    def clues(
        self,
        images: Float[Tensor, "B n 3 V_image"],
        tables: RefinedTables,
        seen: Bool[Tensor, "B n V_image"],
    ) -> SweepClues:
        """Return the results of the sweep, which has no weights, and of the prior."""
        with torch.no_grad():
            evidence, cost = semi_global_costs(images, tables.sweep.sweep, seen)
        mean, best, cameras = evidence.unbind(1)
        indices = _spread_over(cameras.shape[1], images.device)
        cost = cost - cost.amin(1, keepdim=True)
        swept = self.prior.sweep(self.prior.extract_features(images), tables.prior, seen)
        prior = self.prior.regularizer(self.prior.aggregation(swept))
        return SweepClues(cost, best, mean[:, ::2], cameras.index_select(1, indices), prior)

    def fuse(
        self,
        clues: SweepClues,
        images: Float[Tensor, "B n 3 V_image"],
        seen: Bool[Tensor, "B n V_image"],
        offsets: Float[Tensor, "*batch n 3"],
        hint: HintedIndex | None = None,
    ) -> FusedLogits:
        """Return the logits ``(B, M, V)`` one level above the images."""
        prior = clues.prior.float()
        while prior.shape[-1] < clues.cost.shape[-1]:
            prior = icosphere_upsample(prior)
        prior = between_hypotheses(prior.log_softmax(1))
        start = self.fusion.start(clues, prior)
        size = (offsets.norm(dim=-1).mean(-1) / self.min_depth).expand(images.shape[0])
        appearance = self._appearance(start[:, None], images, seen, offsets)
        return self.fusion(clues, prior, start, appearance, self.up, size, hint)  # type: ignore[no-any-return]

    def refinements(
        self,
        fused: FusedLogits,
        views: Sequence[tuple[Tensor, Tensor]],
        offsets: Float[Tensor, "*batch n 3"],
        hints: Sequence[HintedIndex | None] | None = None,
        modes: tuple[Tensor, Tensor] | None = None,
    ) -> list[RefinedIndex]:
        """Return the index at all levels from ``coarse_level + 1`` to ``level``, in inner hypotheses.

        Args:
            fused: result of ``fuse``.
            views: result of ``views``, one for each step; one finer than ``level`` has details for the last step.
            offsets: of the tables.
            hints: at these levels.
            modes: ``two_modes`` of the fused logits; computed when not given.
        """
        answers, trust = [], fused.trust
        if hints is not None and trust is not None:  # a hint without trust is no candidate
            hints = [None if hint is None else hint.trusted(trust) for hint in hints]
        steps = self.level - self.coarse_level
        for number, (images, seen) in enumerate(views[:steps]):
            candidates = candidates_of(fused, modes, None if hints is None else hints[number])
            appearance = self._appearance(candidates.index, images, seen, offsets)
            around = None
            if self.refinement.details is not None and number + 1 < len(views):
                around = self._around(candidates.index[:, 1:3], *views[number + 1], offsets)
            refined: RefinedIndex = self.refinement(
                candidates, appearance, fused.state, self.inner_hypotheses, around
            )
            answers.append(refined)
            if number + 1 < steps:
                fused, modes = finer_logits(fused, refined.index), (refined.index, refined.second)
        return answers

    def _appearance(self, index: Tensor, images: Tensor, seen: Tensor, offsets: Tensor) -> AppearanceAtDepth:
        """Appearance at indices ``(B, K, V)``."""
        offsets = offsets.expand(images.shape[0], -1, -1)
        return appearance_at_depth(images, seen, offsets, self._inverse_depth(index))

    def _around(self, index: Tensor, images: Tensor, seen: Tensor, offsets: Tensor) -> Tensor:
        """Appearance around vertices at the nearest and the farthest index, ``(B, 2, V)``; only at boundaries."""
        offsets, boundary = offsets.expand(images.shape[0], -1, -1), index[:, 0] - index[:, 1] > 1
        return appearance_around(images, seen, offsets, self._inverse_depth(index), boundary)

    def _inverse_depth(self, index: Tensor) -> Tensor:
        index = index.detach().clamp(0, self.inner_hypotheses - 1)
        return inverse_depth_from_index(index, self.inner_hypotheses, self.min_depth)

    def training_loss(
        self,
        images: Float[Tensor, "B n 3 V_image"],
        rig: CameraRig | RefinedTables | list[CameraRig],
        seen: Bool[Tensor, "B n V_image"] | None,
        target: Float[Tensor, "B V"],
        valid: Bool[Tensor, "B V"],
        loss: Callable[..., Tensor],
        hint: DepthHint | None = None,
        clues: SweepClues | None = None,
    ) -> Float[Tensor, ""]:
        """Return the sum of the losses of the index at all levels, the logits, the prior and the confidence.

        Points that fewer than two cameras see have a quarter of the weight, points at edges three times as much. Fused
        logits and the prior's have the cross entropy of the two hypotheses around the true index, fused ones also their
        expected error. The steps of the refinement count by their mean, and do not run if neither the refinement nor
        the gate for hints learns. The target of the confidence falls from 1 to 0 with an error of two hypotheses. Sky
        is where the true index is 0; where there is little of it, as behind windows, it has more weight.

        Args:
            images: as for ``predict``; so are ``rig``, ``seen`` and ``hint``. With ``clues`` a list of rigs is a batch.
            target: the true index.
            valid: where it is known.
            loss: of index, true index and where that is known.
            clues: result of the method ``clues`` for these images. The prior then does not learn, no tables are made of
                the rig, and ``seen`` is needed.
        """
        if clues is None or seen is None:
            tables = rig if isinstance(rig, RefinedTables) else self.tables(rig)  # type: ignore[arg-type]
            seen_in_views = self._seen(tables, images)
            views = self.views(images, seen_in_views if seen is None else seen)
            offsets = tables.offsets
            clues = self.clues(views[0][0], tables, views[0][1])
        else:
            views = self.views(images, seen)
            offsets = _offsets(rig).to(self.up)
        coarse, coarse_seen = views[0]
        if hint is None and _learns(
            self.fusion.hint_gate
        ):  # zero gradients, as DDP wants some of each weight
            hint = DepthHint(torch.zeros_like(target), torch.zeros_like(target))
        hints = self.hints(hint)
        fused = self.fuse(clues, coarse, coarse_seen, offsets, hints[0])
        scale = (self.inner_hypotheses - 1) / (self.num_hypotheses - 1)
        true = (target * scale).clamp(0, self.inner_hypotheses - 1)

        def at_level(level: int) -> tuple[Tensor, Tensor]:
            ids = ids_of_coarser_level(self.level, level, true.device)
            return true[:, ids], valid[:, ids]

        modes = two_modes(fused.logits)
        total = torch.zeros_like(true[0, 0])
        if _learns(self.refinement) or _learns(self.fusion.hint_gate):  # a hint is a candidate of both
            steps = self.refinements(fused, views, offsets, hints[1:], modes)
            total = torch.stack(
                [
                    _loss_of_step(refined, *at_level(level), loss)
                    for level, refined in enumerate(steps, self.coarse_level + 1)
                ]
            ).mean()
        coarse_true, coarse_valid = at_level(self.coarse_level)
        coarse_weights = torch.where(clues.cameras.amax(1) >= 2, 1.0, 0.25) * _edge_weights(
            coarse_true, coarse_valid
        )
        total = total + 0.4 * loss(modes[0], coarse_true, coarse_valid, weights=coarse_weights)
        total = total + mean_of_samples(_loss_of_modes(fused.logits, coarse_true), coarse_weights)
        prior_level = self.coarse_level - 1
        ids = ids_of_coarser_level(self.coarse_level, prior_level, true.device)
        # The prior tries no hypotheses between the N.
        entropy = -at_index(clues.prior.float().log_softmax(1), at_level(prior_level)[0] / 2)
        return total + PRIOR_SHARE * mean_of_samples(entropy, coarse_weights[:, ids])


def _learns(module: nn.Module) -> bool:
    return any(weight.requires_grad for weight in module.parameters())


@constant_table
def _spread_over(number: int, device: torch.device) -> Tensor:
    """Four evenly spaced hypotheses, from the first to the last."""
    return torch.linspace(0, number - 1, 4, device=device).round().long()


def _offsets(rig: CameraRig | RefinedTables | list[CameraRig]) -> Tensor:
    """``(*b, n, 3)`` from each camera to the centre of its rig; a list is a batch."""
    if isinstance(rig, RefinedTables):
        return rig.offsets
    if isinstance(rig, list):
        return torch.stack([_offsets(each) for each in rig])
    return rig.center[..., None, :] - rig.positions


def _loss_of_step(refined: RefinedIndex, true: Tensor, valid: Tensor, loss: Callable[..., Tensor]) -> Tensor:
    """Loss of index, confidence and sky at one level."""
    weights = torch.where(refined.seen, 1.0, 0.25) * _edge_weights(true, valid)
    sure = 1 - (refined.index.detach() - true).abs().clamp(max=DOUBTFUL) / DOUBTFUL
    doubt = F.binary_cross_entropy_with_logits(refined.confidence, sure, reduction="none")
    sky = (true <= 0) & valid
    rarity = (RARE_SKY / sky.float().mean(-1, keepdim=True).clamp(min=1e-6)).clamp(1, MOST)
    # More weight shifts a logit by the logarithm of the weight: the loss takes the shifted logit, so that the logit
    # itself stays that of the probability of sky.
    shifted = refined.sky + rarity.log()
    sky_loss = F.binary_cross_entropy_with_logits(shifted, sky.to(sure), reduction="none")
    doubt = doubt + sky_loss * torch.where(sky, rarity, 1.0)
    return loss(refined.index, true, valid, weights=weights) + 0.1 * mean_of_samples(doubt, valid)


def _edge_weights(true: Tensor, valid: Tensor) -> Tensor:
    """Weights ``(B, V)``: 0 where the true index is unknown, 1, and more at its edges."""
    # Most of the error is there, and most of that where the coarse index has missed or fattened something.
    rings = vertex_rings(level_from_num_vertices(true.shape[-1]), true.device)
    around, known = true[:, rings], valid[:, rings]
    highest = around.masked_fill(~known, -torch.inf).amax(-1)
    lowest = around.masked_fill(~known, torch.inf).amin(-1)
    return valid * (1 + EDGE_WEIGHT * (highest - lowest > 1))


def _loss_of_modes(logits: Tensor, index: Tensor) -> Tensor:
    """Cross entropy ``(B, V)`` of logits ``(B, 2 N - 1, V)`` and their expected distance from the index, weighted."""
    likely = logits.log_softmax(1)
    distance = (tried_index(logits.shape[1], logits.device) - index[:, None]).abs()
    expected_error = (likely.exp() * distance).sum(1)
    return EXPECTED_ERROR_SHARE * expected_error - ENTROPY_SHARE * at_index(likely, index)


register_network("refinedsweepnet", RefinedSweepNet)
