# SPDX-License-Identifier: Apache-2.0
"""Depth without a network, where a network would stand: the semi-global sweep at a level, scale and number."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from sphericalvision.cameras import CameraRig
from sphericalvision.icosphere import Icosphere
from sphericalvision.models import IcoSweepNet, OmniMVS
from sphericalvision.sweep import semi_global_sweep

__all__ = ["SemiGlobalSweep"]


class SemiGlobalSweep(nn.Module):
    """``semi_global_sweep`` called like a network: sphere images and a rig to the index at one level below.

    Args:
        level: of the images.
        num_hypotheses: N.
        min_depth: nearest hypothesis in metres.
    """

    directions: Tensor

    def __init__(self, level: int, num_hypotheses: int, min_depth: float) -> None:
        super().__init__()
        self.level, self.num_hypotheses, self.min_depth = level, num_hypotheses, min_depth
        self.register_buffer("directions", Icosphere(level - 1).vertices, persistent=False)

    @classmethod
    def like(cls, net: IcoSweepNet | OmniMVS) -> SemiGlobalSweep:
        """With the hypotheses of a network, and its level (5 for one on panoramas), on its device."""
        level = net.level if isinstance(net, IcoSweepNet) else 5
        return cls(level, net.num_hypotheses, net.min_depth).to(next(net.parameters()).device)

    def forward(self, images: Tensor, rig: CameraRig) -> Tensor:
        """Index ``(B, V_{level-1})`` of images ``(B, n, 3, V_level)``."""
        with torch.no_grad():
            return semi_global_sweep(
                images, rig, self.num_hypotheses, self.min_depth, level=self.level - 1
            ).index
