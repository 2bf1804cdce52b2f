# SPDX-License-Identifier: Apache-2.0
"""Normalisation as part of the steps beside it: folded into a convolution, or rectified in place."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.modules.batchnorm import _BatchNorm

from sphericalvision.crown.fast.block import Moments
from sphericalvision.crown.fast.double_backward import reference_gradients
from sphericalvision.crown.fast.norm_passes import NativePasses, TorchPasses

PRECISIONS = (torch.float32, torch.float64)
"""That operators in C++ know."""

__all__ = ["folded", "is_affine", "normalize", "normalizes", "track"]


def is_affine(norm: _BatchNorm) -> bool:
    """Whether it is one multiplication and one addition a channel, as batch normalisation is in evaluation."""
    return not norm.training and norm.running_var is not None


def folded(
    weight: Float[Tensor, "O C taps"], norm: _BatchNorm
) -> tuple[Float[Tensor, "O C taps"], Float[Tensor, " O"]]:
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


def normalizes(col: Float[Tensor, "B 5 C *N h w"], norm: Any) -> bool:
    """Whether ``normalize`` can: by statistics of what is given, in the precision of the parameters, on a CPU."""
    fits = norm.weight is not None and norm.weight.dtype == col.dtype and col.device.type == "cpu"
    return fits and not is_affine(norm) and not torch.is_autocast_enabled("cpu")


def normalize(
    col: Float[Tensor, "B 5 C *N h w"],
    row: Float[Tensor, "B 5 C *N w h"],
    norm: Any,
    relu: bool,
    native: bool = False,
) -> tuple[Float[Tensor, "B 5 C *N h w"], Float[Tensor, "B 5 C *N w h"]]:
    """Normalise rectangles by their own statistics, which running averages take in, and rectify them, if asked for.

    Channels stay next to each other in memory, where the layers of torch, which normalise channels one by one, would
    reorder the rectangles before and the convolution after them once more.

    References:
        Ioffe and Szegedy (2015), "Batch normalization", for the gradient.
    """
    first, second, mean, variance = _Normalize.apply(
        col, row, norm.weight, norm.bias, norm.eps, norm.per_sample, relu, native and col.dtype in PRECISIONS
    )
    track(norm, Moments(mean, variance, 2 * col.numel() // col.shape[2]))
    return first, second


def _plain_normalize(eps: float, per_sample: bool, relu: bool) -> Callable[..., tuple[Tensor, Tensor]]:
    """The same in plain torch, for second derivatives."""

    def normalized(col: Tensor, row: Tensor, weight: Tensor, bias: Tensor) -> tuple[Tensor, Tensor]:
        flat = torch.cat([_places(rectangles) for rectangles in (col, row)], 1)
        over = (1,) if per_sample else (0, 1)
        mean = flat.mean(over, keepdim=True)
        variance = (flat - mean).square().mean(over, keepdim=True)
        flat = (flat - mean) * (variance + eps).rsqrt() * weight + bias
        first, second = (flat.relu() if relu else flat).chunk(2, 1)
        return _rectangles(first, col), _rectangles(second, row)

    return normalized


def _places(rectangles: Tensor) -> Tensor:
    """Rectangles ``(B, 5, C, *)`` as ``(B, places, C)``, a view where channels are innermost in memory."""
    return rectangles.movedim(2, -1).flatten(1, -2)


def _rectangles(places: Tensor, like: Tensor) -> Tensor:
    """Undo ``_places``."""
    return places.view(like.movedim(2, -1).shape).movedim(-1, 2)


class _Normalize(torch.autograd.Function):
    """Rectangles to normalised rectangles, col and row, and the statistics; those of several samples in rows.

    Kept for the backward pass are the rectangles given and those returned, which the convolutions beside keep, too.
    """

    @staticmethod
    def forward(
        ctx: Any,
        col: Tensor,
        row: Tensor,
        weight: Tensor,
        bias: Tensor,
        eps: float,
        per_sample: bool,
        relu: bool,
        native: bool,
    ) -> tuple[Tensor, ...]:
        passes = NativePasses if native else TorchPasses
        values = [_places(rectangles) for rectangles in (col, row)]
        mean, variance = passes.moments(values, per_sample)
        invert = (variance + eps).rsqrt()
        factor = invert * weight
        offset = bias - mean * factor
        results = [passes.scale_shift(x, factor, offset, relu) for x in values]
        first, second = (_rectangles(x, like) for x, like in zip(results, (col, row), strict=True))
        ctx.save_for_backward(col, row, weight, bias, mean, invert, *((first, second) if relu else ()))
        ctx.options, ctx.passes = (eps, per_sample, relu), passes
        statistics = mean.flatten(), variance.flatten()
        ctx.mark_non_differentiable(*statistics)
        return first, second, *statistics

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        col, row, weight, bias, mean, invert, *rectified = ctx.saved_tensors
        if torch.is_grad_enabled():
            reference, inputs = _plain_normalize(*ctx.options), (col, row, weight, bias)
            needed = ctx.needs_input_grad[:4]
            return *reference_gradients(reference, inputs, needed, *gradients[:2]), *(None,) * 4
        passes, per_sample = ctx.passes, ctx.options[1]
        values, upstream = ([_places(x) for x in pair] for pair in ((col, row), gradients[:2]))
        open_at: list[Tensor | None] = [_places(x) for x in rectified] or [None, None]
        number = 2 * values[0].shape[1] * (1 if per_sample else len(col))
        # A place has a gradient of its own and, through mean and variance, a share of the sums of all places'.
        sums = [
            passes.gradient_sums(g, x, y, mean, per_sample)
            for g, x, y in zip(upstream, values, open_at, strict=True)
        ]
        total, along = (torch.stack(both).sum(0) for both in zip(*sums, strict=True))
        along = along * invert  # the sum of gradients times normalised values
        factor = invert * weight
        by_value = -factor * invert * along / number
        constant = -factor * total / number - by_value * mean
        found = [
            _rectangles(passes.gradient(g, x, y, factor, by_value, constant), like)
            for g, x, y, like in zip(upstream, values, open_at, (col, row), strict=True)
        ]
        return *found, along.sum((0, 1)), total.sum((0, 1)), *(None,) * 4


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
