# SPDX-License-Identifier: Apache-2.0
"""Depth of a capture without truth, as a trained network and a sweep agree on it: labels to learn from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.icosphere import Icosphere
from sphericalvision.models import DepthNetwork
from sphericalvision.sphere.intake import Intake
from sphericalvision.sweep import (
    correlation_evidence,
    inverse_depth_from_index,
    semi_global_sweep,
    semi_global_tables,
)
from sphericalvision.sweep.consistency_share import consistency_share

UNSURE, SURE = 0.5, 0.8
"""Confidence of the network below which it teaches nothing, and of the sweep from which that answers in its place."""
ALL_SURE = 0.99
"""Of the weights with which the sweep's confidence at a vertex is interpolated, what must come from sure places."""


class PseudoLabels(NamedTuple):
    """What is taken for the depth of a frame.

    Attributes:
        inverse_depth: ``(V_depth,)`` in 1/m on the network's grid.
        valid: ``(V_depth,)`` where it is to be learned.
        correlation: ``(M, V)`` of the better half of the cameras at the M hypotheses that were tried, 0 to 255; other
            estimates are judged by it.
        seen: ``(M, V)`` whether two cameras see the point.
        share: photo-consistency of what the network says, of that of winner-takes-all.
    """

    inverse_depth: Float[Tensor, " V_depth"]
    valid: Bool[Tensor, " V_depth"]
    correlation: UInt8[Tensor, "M V"]
    seen: Bool[Tensor, "M V"]
    share: float


class PseudoLabeller:
    """Labels are what a network says where it is sure, and a semi-global sweep where that is sure and the network not.

    Args:
        net: on icospheres.
        rig: in metres in which the network's nearest hypothesis is that of the capture.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.models import IcoSweepNet
        >>> rig = ring_rig(3, image_size=(32, 32))
        >>> net = IcoSweepNet(level=3, num_hypotheses=4, feature_channels=2, num_cameras=3)
        >>> images = {name: torch.rand(3, 32, 32) for name in rig.names}
        >>> PseudoLabeller(net, rig)(images).inverse_depth.shape
        torch.Size([42])
    """

    def __init__(self, net: DepthNetwork, rig: CameraRig) -> None:
        self.net = net
        self.intake = Intake(rig, Icosphere(net.level))
        self.hypotheses = (net.num_hypotheses, net.min_depth)
        self.coarse = Icosphere(max(net.level - 1, 0))
        self.sweep = semi_global_tables(rig, *self.hypotheses, net.level)
        with torch.no_grad():
            self.tables = net.tables(rig)

    @torch.no_grad()
    def __call__(self, images: Mapping[str, Float[Tensor, "3 _ _"]]) -> PseudoLabels:
        """Return the labels of a frame, camera name -> ``(3, h, w)`` in [0, 1], without disturbances."""
        net, coarse = self.net, self.coarse
        on_sphere, seen = self.intake(images)[None], self.intake.seen[None]
        training = net.training
        net.eval()
        estimate = net.predict(on_sphere, self.tables, seen)
        net.train(training)
        swept = semi_global_sweep(on_sphere, self.sweep, *self.hypotheses, coarse.level, seen=seen)
        _, correlation, cameras = correlation_evidence(on_sphere, self.sweep.sweep, seen).unbind(1)
        two_see = cameras >= 2
        position = net.index_at(estimate.index, coarse.vertices)[0] / (net.num_hypotheses - 1)
        fraction = float(consistency_share(position, correlation, two_see))
        sure_sweep, swept_index = (
            coarse.sample(values[:, None], net.grid.directions)[:, 0]
            for values in ((swept.confidence > SURE).float(), swept.index)
        )
        corrected = (sure_sweep > ALL_SURE) & (estimate.confidence < UNSURE)
        index = swept_index.where(corrected, estimate.index)
        inverse_depth = inverse_depth_from_index(index, *self.hypotheses)
        valid, levels = corrected | (estimate.confidence >= UNSURE), (correlation[0] * 255).round().byte()
        return PseudoLabels(inverse_depth[0], valid[0], levels, two_see[0], fraction)
