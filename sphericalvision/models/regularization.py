# SPDX-License-Identifier: Apache-2.0
"""Regularisation of a cost volume on icospheres: 3D crown convolutions over directions and hypotheses."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from sphericalvision.crown import (
    Crown,
    CrownConv3d,
    CrownInstanceNorm3d,
    crown_conv3d,
    crown_norm,
    crown_relu,
    from_crown,
    to_crown,
)
from sphericalvision.crown.fast.block import NormedLayer, block3d_pays, crown_block3d
from sphericalvision.crown.fast.chain import convolve_chain
from sphericalvision.crown.fast.winograd_rows import Workspace
from sphericalvision.models.recompute import recomputed

__all__ = ["ConvNorm3d", "CostBlock", "CostRegularizer"]


class ConvNorm3d(nn.Module):
    """A 3D crown convolution and the normalisation after it, ``"batch"`` or ``"instance"``."""

    def __init__(self, in_channels: int, out_channels: int, norm: str = "batch") -> None:
        super().__init__()
        self.conv = CrownConv3d(in_channels, out_channels)
        self.norm = crown_norm(norm, 3, out_channels)

    @property
    def layer(self) -> tuple[Tensor, Tensor]:
        """Weight and bias of the convolution with its normalisation in it, where that is affine."""
        return self.norm.folded(self.conv.weight)

    @property
    def normed_layer(self) -> NormedLayer:
        """The convolution and its normalisation by the statistics of what it gets."""
        return NormedLayer(self.conv.weight, self.norm.weight, self.norm.bias, self.norm.eps)

    def forward(self, crown: Crown) -> Crown:
        if self.norm.is_affine:
            return crown_conv3d(crown, *self.layer)
        return self.norm(self.conv(crown))


class CostBlock(nn.Module):
    """Two normalised 3D convolutions with a ReLU between them, from vertices to vertices."""

    def __init__(
        self, in_channels: int, hidden_channels: int, out_channels: int, norm: str = "batch"
    ) -> None:
        super().__init__()
        self.first = ConvNorm3d(in_channels, hidden_channels, norm)
        self.second = ConvNorm3d(hidden_channels, out_channels, norm)

    def forward(self, volume: Tensor, native: bool = False, workspace: Workspace | None = None) -> Tensor:
        """Convolve; with a workspace the result may be in it, where the next block overwrites it."""
        if self.first.norm.is_affine and self.second.norm.is_affine and not torch.is_grad_enabled():
            layers = [self.first.layer, self.second.layer]
            return convolve_chain(volume, layers, native, workspace or Workspace(), workspace is not None)
        if _by_rectangles(volume, self.first, self.second):
            return _in_samples(volume, self.first, self.second, native)
        return from_crown(self.second(crown_relu(self.first(to_crown(volume)))))


def _by_rectangles(volume: Tensor, *layers: ConvNorm3d) -> bool:
    """Whether ``crown_block3d`` does the same as these layers, faster."""
    return (
        all(block3d_pays(volume, layer.conv.weight) for layer in layers)
        and not any(layer.norm.is_affine for layer in layers)
        and not torch.compiler.is_compiling()
        and not torch.is_autocast_enabled(volume.device.type)
    )


def _in_samples(volume: Tensor, first: ConvNorm3d, second: ConvNorm3d | NormedLayer, native: bool) -> Tensor:
    """``crown_block3d``, a sample at a time for instance normalisation, and a step of running statistics."""
    end = second if isinstance(second, NormedLayer) else second.normed_layer
    results = []
    for some in volume.split(1 if isinstance(first.norm, CrownInstanceNorm3d) else len(volume)):
        result, moments = crown_block3d(some, first.normed_layer, end, native)
        results.append(result)
        for layer, moment in zip((first, second), moments, strict=False):
            if isinstance(layer, ConvNorm3d):
                layer.norm.track(moment)
    return results[0] if len(results) == 1 else torch.cat(results)


class CostRegularizer(nn.Module):
    """Map a cost volume ``(B, in_channels, N, V)`` to a score of each hypothesis ``(B, N, V)``.

    A block ends with the mean of the crown's two directions, which is where they exchange what they know.
    That mean is linear and leaves values that both agree on as they are, so the residual connections are kept
    on vertices, not on crowns.

    Args:
        in_channels: of the volume.
        channels: half the width of the blocks.
        norm: "batch" or "instance".
        fusion_channels: width between the first two convolutions; ``in_channels`` when not given.

    Attributes:
        recompute: whether to save memory in training by computing the inside of each block twice.
        native: whether forward passes use operators in C++ where they are faster; see ``crown_conv3d_chain``.

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
        self.recompute = False
        self.native = False
        width = 2 * channels
        self.fusion = CostBlock(in_channels, fusion_channels or in_channels, width, norm)
        self.blocks = nn.ModuleList(CostBlock(width, width, width, norm) for _ in range(4))
        self.reduction = ConvNorm3d(width, channels, norm)
        self.score = CrownConv3d(channels, 1)

    def forward(self, volume: Tensor) -> Tensor:
        return self.refine(self.fuse(volume))

    def fuse(self, volume: Tensor) -> Tensor:
        """The first block, ``(B, 2 * channels, N, V)``: after it the large volume it was given can go."""
        return self._run(self.fusion, volume, None)

    def refine(self, volume: Tensor) -> Tensor:
        """All that follows ``fuse``, in whose volume it works where no gradient is wanted."""
        workspace = Workspace()  # fresh memory for each block would cost as much as the sums
        for block in self.blocks:
            change = self._run(block, volume, workspace)
            volume = volume + change if torch.is_grad_enabled() else volume.add_(change)
            del change
        if self.reduction.norm.is_affine and not torch.is_grad_enabled():
            layers = [self.reduction.layer, (self.score.weight, self.score.bias)]
            return convolve_chain(volume, layers, self.native, workspace).squeeze(1)
        if _by_rectangles(volume, self.reduction) and self.score.bias is None:
            end = NormedLayer(self.score.weight)
            return _in_samples(volume, self.reduction, end, self.native).squeeze(1)
        crown = crown_relu(self.reduction(to_crown(volume)))
        return from_crown(self.score(crown)).squeeze(1)

    def _run(self, block: nn.Module, volume: Tensor, workspace: Workspace | None) -> Tensor:
        if self.recompute and self.training:
            return recomputed(block, volume)
        return block(volume, self.native, workspace)
