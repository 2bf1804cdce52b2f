# SPDX-License-Identifier: Apache-2.0
"""A U-Net of hexagonal convolutions on icospheres."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from jaxtyping import Float
from torch import Tensor, nn

from sphericalvision.core import ArgumentError
from sphericalvision.crown import HexConv2d
from sphericalvision.icosphere import icosphere_upsample


class HexResidualBlock(nn.Module):
    """A residual block of two hexagonal convolutions of values ``(B, C, V)``; the identity before training.

    The second convolution begins at zero, in place of normalisation: values keep their scale, and the result of a
    sample does not depend on others.

    References:
        Zhang et al. (2019), "Fixup initialization: residual learning without normalization"; He et al. (2015), "Delving
        deep into rectifiers", for the first one's weights.

    Examples:
        >>> import torch
        >>> values = torch.rand(1, 4, 162)
        >>> torch.equal(HexResidualBlock(4)(values), values)
        True
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = _keeping_size(channels, channels)
        self.second = _at_zero(HexConv2d(channels, channels, bias=True))

    def forward(self, values: Float[Tensor, "B C V"]) -> Float[Tensor, "B C V"]:
        return self.second(self.first(values, rectify=True), rectify=True, residual=values)  # type: ignore[no-any-return]


class HexUNet(nn.Module):
    """A U-Net of values ``(B, C, V)`` on an icosphere; the identity before training.

    Args:
        widths: channels at the level of the values and at each coarser one.
        blocks: residual blocks at each level on the way down, and again on the way up; or their number level by level.

    Raises:
        ArgumentError: for other numbers of blocks than of widths.

    References:
        Ronneberger et al. (2015), "U-Net: convolutional networks for biomedical image segmentation".

    Examples:
        >>> import torch
        >>> HexUNet((4, 6, 8))(torch.rand(1, 4, 162)).shape
        torch.Size([1, 4, 162])
    """

    def __init__(self, widths: Sequence[int], blocks: int | Sequence[int] = 1) -> None:
        super().__init__()
        counts = [blocks] * len(widths) if isinstance(blocks, int) else list(blocks)
        if len(counts) != len(widths) or min(counts) < 1:
            raise ArgumentError(
                f"blocks: expected a number from 1 on for each of {len(widths)} widths, got {blocks}"
            )
        steps = list(pairwise(widths))
        self.down = nn.ModuleList(_blocks(*level) for level in zip(widths, counts, strict=True))
        self.coarsen = nn.ModuleList(_keeping_size(fine, coarse, stride=2) for fine, coarse in steps)
        # Random values of the coarser levels would be noise, which the first steps of a training would make smaller.
        # From zero these levels keep larger values; a high learning rate silences them all the same.
        self.refine = nn.ModuleList(_at_zero(nn.Conv1d(coarse, fine, 1)) for fine, coarse in steps)
        self.up = nn.ModuleList(_blocks(*level) for level in zip(widths[:-1], counts, strict=False))

    def forward(self, values: Float[Tensor, "B C V"]) -> Float[Tensor, "B C V"]:
        levels = []
        for block, coarsen in zip(self.down, self.coarsen, strict=False):
            levels.append(block(values))
            values = coarsen(levels[-1], rectify=True)
        values = self.down[-1](values)
        for fine, refine, block in zip(levels[::-1], reversed(self.refine), reversed(self.up), strict=True):
            values = block(fine + icosphere_upsample(refine(values)))
        return values


def _blocks(channels: int, count: int) -> nn.Sequential:
    return nn.Sequential(*(HexResidualBlock(channels) for _ in range(count)))


def _keeping_size(in_channels: int, out_channels: int, stride: int = 1) -> HexConv2d:
    """A convolution whose rectified results begin as large as its inputs."""
    # Nothing is normalised: this alone keeps values their size from level to level. With weights as torch begins, those
    # of the coarsest of five levels are a thirtieth of the finest's, and hardly learn.
    convolution = HexConv2d(in_channels, out_channels, stride, bias=True)
    nn.init.kaiming_normal_(convolution.weight, nonlinearity="relu")
    nn.init.zeros_(convolution.bias)  # type: ignore[arg-type]
    return convolution


def _at_zero(convolution: nn.Module) -> nn.Module:
    """The convolution with weights of zero; it learns at once, since its inputs are not zero."""
    for weights in convolution.parameters():
        nn.init.zeros_(weights)
    return convolution
