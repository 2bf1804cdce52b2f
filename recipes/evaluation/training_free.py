# SPDX-License-Identifier: Apache-2.0
"""Depth without training, where a network would stand: the semi-global sweep."""

from __future__ import annotations

import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.icosphere import Icosphere
from sphericalvision.models import DepthNetwork
from sphericalvision.sweep import DepthEstimate, semi_global_sweep

__all__ = ["SemiGlobalSweep"]


class SemiGlobalSweep(DepthNetwork):
    """``semi_global_sweep`` as a network without parameters: its answer is one level below the images'.

    Args:
        level: of the images.
        num_hypotheses: N.
        min_depth: nearest hypothesis in metres.
    """

    def __init__(self, level: int = 6, num_hypotheses: int = 16, min_depth: float = 0.55) -> None:
        super().__init__(num_hypotheses, min_depth, num_cameras=2, any_cameras=True)
        self.level, self.grid = level, Icosphere(level - 1)

    @classmethod
    def like(cls, net: DepthNetwork) -> SemiGlobalSweep:
        """With the hypotheses of a network, and the level of its images (5 if these are not on an icosphere)."""
        level = net.level if net.images == "sphere" else 5
        return cls(level, net.num_hypotheses, net.min_depth).to(net.device)

    @torch.no_grad()
    def predict(self, images: Tensor, rig: CameraRig, seen: Tensor | None = None) -> DepthEstimate:
        """Index, confidence and where two cameras agree, each ``(B, V_{level-1})``."""
        index, confidence = semi_global_sweep(
            images, rig, self.num_hypotheses, self.min_depth, level=self.level - 1, seen=seen
        )[:2]
        return DepthEstimate(index, confidence, confidence > 0)
