# SPDX-License-Identifier: Apache-2.0
"""Regularisation of a cost volume on icospheres: 3D crown convolutions over directions and hypotheses."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn

from sphericalvision.crown import CrownBlock3d, CrownConv3d, CrownConvNorm3d, crown_block3d

__all__ = ["CostRegularizer"]


class CostRegularizer(nn.Module):
    """Map a cost volume ``(B, in_channels, N, V)`` to a score of each hypothesis ``(B, N, V)``.

    ==========  ================================  ==================================================
    name        channels                          what it does
    ==========  ================================  ==================================================
    fusion      in -> fusion -> 2 * channels      brings the cameras together
    blocks      2 * channels, four times two      are added to what they are given
    reduction   2 * channels -> channels          begins the last pair of convolutions
    score       channels -> 1                     ends it
    ==========  ================================  ==================================================

    Every convolution but the last is normalised, and a ReLU lies between the two of a pair. A pair ends with the mean
    of the crown's two directions, which is where they exchange what they know. That mean is linear and leaves values
    that both agree on as they are, so residuals are added on vertices, not on crowns.

    Args:
        in_channels: of the volume.
        channels: half the width of the blocks.
        norm: "batch" or "instance".
        fusion_channels: width between the first two convolutions; ``in_channels`` when not given.

    References:
        Komatsu et al. (2020), "360° depth estimation from multiple fisheye images with origami crown
        representation of icosahedron", table of layers.

    Examples:
        >>> import torch
        >>> CostRegularizer(in_channels=8, channels=2)(torch.zeros(1, 8, 4, 42)).shape
        torch.Size([1, 4, 42])
    """

    def __init__(
        self,
        in_channels: int = 128,
        channels: int = 32,
        norm: str = "batch",
        fusion_channels: int | None = None,
    ) -> None:
        super().__init__()
        width = 2 * channels
        self.fusion = CrownBlock3d(in_channels, fusion_channels or in_channels, width, norm)
        self.blocks = nn.ModuleList(CrownBlock3d(width, width, width, norm, residual=True) for _ in range(4))
        self.reduction = CrownConvNorm3d(width, channels, norm, relu=True)
        self.score = CrownConv3d(channels, 1)

    def forward(self, volume: Float[Tensor, "B C N V"]) -> Float[Tensor, "B N V"]:
        return self.refine(self.fusion(volume))

    def refine(self, volume: Float[Tensor, "B C N V"]) -> Float[Tensor, "B N V"]:
        """Score what ``fusion`` returns; who calls both in turn can let go of the large volume in between."""
        for block in self.blocks:
            volume = block(volume)
        return crown_block3d(volume, self.reduction, self.score).squeeze(1)
