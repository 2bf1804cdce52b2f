# SPDX-License-Identifier: Apache-2.0
"""Normalisation as part of the steps beside it: folded into a convolution, or rectified in place."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.modules.batchnorm import _BatchNorm

from sphericalvision.crown.fast.block import Moments

__all__ = ["folded", "is_affine", "normalize", "track"]


def is_affine(norm: _BatchNorm) -> bool:
    """Whether it is one multiplication and one addition a channel, as batch normalisation is in evaluation."""
    return not norm.training and norm.running_var is not None


def folded(weight: Tensor, norm: _BatchNorm) -> tuple[Tensor, Tensor]:
    """Return weight ``(out, in, taps)`` and bias of a convolution that normalises, too, where ``is_affine``."""
    assert norm.running_mean is not None
    assert norm.running_var is not None
    scale = (norm.running_var + norm.eps).rsqrt()
    if norm.weight is not None:
        scale = scale * norm.weight
    shift = -norm.running_mean * scale
    if norm.bias is not None:
        shift = shift + norm.bias
    return weight * scale[:, None, None], shift


def normalize(col: Tensor, row: Tensor, norm: _BatchNorm, relu: bool) -> tuple[Tensor, Tensor]:
    """Normalise rectangles of all samples together, and rectify them in the memory that they are in then."""
    # Both kinds of rectangle have as many places: with the places in one dimension they are one batch.
    both = torch.cat([rectangles.flatten(0, 1).flatten(-2) for rectangles in (col, row)])
    both = _BatchNorm.forward(norm, both)
    if relu:
        both = both.relu_()
    first, second = both.chunk(2)  # unlike unbind, its gradient keeps the channels innermost in memory
    return first.view(col.shape), second.view(row.shape)


@torch.no_grad()
def track(norm: _BatchNorm, moments: Moments) -> None:
    """Let running statistics take a step towards those of a batch, as ``forward`` does in training mode."""
    if not norm.training or norm.running_mean is None:
        return
    assert norm.running_var is not None
    assert norm.num_batches_tracked is not None
    norm.num_batches_tracked.add_(1)
    rate = 1 / float(norm.num_batches_tracked) if norm.momentum is None else norm.momentum
    norm.running_mean.lerp_(moments.mean, rate)
    norm.running_var.lerp_(moments.variance * (moments.places / (moments.places - 1)), rate)
