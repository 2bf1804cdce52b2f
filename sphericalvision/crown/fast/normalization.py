# SPDX-License-Identifier: Apache-2.0
"""Normalisation of a crown by its own statistics, and the ReLU and the convolution after it, in one operator.

Two passes over memory each way, where layers of torch take nine and sixteen; and one if a convolution follows, which
normalises while it reads, so that the tensor between is never written. Kept for the backward pass are the rectangles
given alone: what was rectified follows from them and the statistics, by a product and a sum.

References:
    Ioffe and Szegedy (2015), "Batch normalization", for the gradient; Chan, Golub and LeVeque (1983), "Algorithms for
    computing the sample variance", for statistics of chunks; Rota Bulò, Porzi and Kontschieder (2018), "In-place
    activated batchnorm for memory-optimized training of DNNs", for what need not be kept: they compute back from
    results, which a ReLU does not allow, and we forth from what is given.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from sphericalvision.crown.fast.convolution import convolution, convolution_gradients, plain_convolution
from sphericalvision.crown.fast.registering import Operator

CHUNK = 128
"""Places whose moments the operator takes at once; ``normalization.cpp`` has the same number."""


def _normalization(
    col: Tensor,
    row: Tensor,
    scale: Tensor,
    shift: Tensor,
    weight: Tensor | None,
    bias: Tensor | None,
    eps: float,
    per_sample: bool,
    relu: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Normalise rectangles by their own statistics, rectify them if asked for, and convolve what was rectified.

    Args:
        col: ``(B, 5, N, h, w, C)``.
        row: ``(B, 5, N, w, h, C)``.
        scale: ``(C,)``.
        shift: ``(C,)``.
        weight: of a convolution that follows, ``(O, C, 7 or 21)``.
        bias: of that convolution, ``(O,)``.
        eps: added to the variance.
        per_sample: whether each sample is normalised by its own statistics.
        relu: whether a ReLU follows, as it does before a convolution.

    Returns:
        rectangles, of O channels if convolved; and mean and biased variance, ``(B or 1, C)``, which are not
        differentiable.
    """
    values = _places((col, row))
    mean, variance = _moments(values, per_sample)
    factor, offset = _scaling(mean, variance, scale, shift, eps)
    results = []
    for across, (x, like) in enumerate(zip(values, (col, row), strict=True)):
        if weight is None:
            result = torch.empty_like(x)
            torch.ops.sphericalvision.scale_shift(x, factor, offset, relu, result)
            results.append(result.view(like.shape))
        else:
            volumes = x.view(like.shape).flatten(0, 1)
            result = convolution(volumes, weight, bias, bool(across), False, False, None, (factor, offset))
            results.append(result.unflatten(0, (-1, 5)))
    return results[0], results[1], mean, variance


def _gradients(
    upstream: Sequence[Tensor],
    inputs: Sequence[Any],
    statistics: Sequence[Tensor],
    needs_grad: Sequence[bool],
) -> list[Tensor | None]:
    """Gradients of col, row, scale, shift, weight and bias.

    Each place has a direct gradient and, through mean and variance, a part of the sums over all places. Together,
    per channel, this is ``factor * gradient + by_value * value + constant``.
    """
    col, row, scale, shift, weight, bias, eps, per_sample, relu = inputs
    mean, variance = statistics
    values = _places((col, row))
    factor, offset = _scaling(mean, variance, scale, shift, eps)
    gradients, by_weight = _places(upstream), [None, None]
    # Backwards through the convolutions, which normalise their inputs again while they read.
    if weight is not None:
        kinds: list[Any] = [
            convolution_gradients(
                [gradient.flatten(0, 1)],
                (x.view(like.shape).flatten(0, 1), weight, bias, across, False, False, None),
                (),
                (True, *needs_grad[4:]),
                (factor, offset),
            )
            for gradient, x, like, across in zip(upstream, values, (col, row), (False, True), strict=True)
        ]
        gradients = [kind[0].view(x.shape) for kind, x in zip(kinds, values, strict=True)]
        by_weight = [None if a is None else a + b for a, b in list(zip(*kinds, strict=True))[1:3]]
    # The first pass: sums of all places, a row for every chunk, added up in the same order by any number of threads.
    over = (1,) if per_sample else (0, 1)
    operators, invert = torch.ops.sphericalvision, (variance + eps).rsqrt()
    total, along = torch.zeros_like(mean), torch.zeros_like(mean)
    for g, x in zip(gradients, values, strict=True):
        totals = _per_chunk(x)
        products = torch.empty_like(totals)
        operators.gradient_sums(g, x, factor, offset, relu, mean, totals, products)
        total += totals.sum(over)
        along += products.sum(over)
    along *= invert  # the sum of gradients times normalised values
    number = _number(values, per_sample)
    by_value = -factor * invert * along / number
    constant = -factor * total / number - by_value * mean
    # The second pass. It writes over the convolutions' gradients, which nothing else uses.
    input_gradients = [torch.empty_like(x) for x in values] if weight is None else gradients
    for g, x, result in zip(gradients, values, input_gradients, strict=True):
        operators.normalized_gradient(g, x, factor, offset, relu, by_value, constant, result)
    first, second = (x.view(like.shape) for x, like in zip(input_gradients, (col, row), strict=True))
    return [first, second, along.sum(0), total.sum(0), *by_weight]


def _plainly(*inputs: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The same as ``_normalization`` in plain torch."""
    col, row, scale, shift, weight, bias, eps, per_sample, relu = inputs
    flat = torch.cat([x.flatten(1, -2) for x in (col, row)], 1)
    over = (1,) if per_sample else (0, 1)
    mean = flat.mean(over, keepdim=True)
    variance = (flat - mean).square().mean(over, keepdim=True)
    flat = (flat - mean) * (variance + eps).rsqrt() * scale + shift
    pair = [
        x.view(y.shape) for x, y in zip((flat.relu() if relu else flat).chunk(2, 1), (col, row), strict=True)
    ]
    if weight is not None:
        pair = [
            plain_convolution(x.flatten(0, 1), weight, bias, bool(across), False, False, None).unflatten(
                0, (-1, 5)
            )
            for across, x in enumerate(pair)
        ]
    return pair[0], pair[1], mean.flatten(0, 1), variance.flatten(0, 1)


crown_normalization = Operator(
    "crown_normalization(Tensor col, Tensor row, Tensor scale, Tensor shift, Tensor? weight, Tensor? bias, float eps, "
    "bool per_sample, bool relu) -> (Tensor, Tensor, Tensor, Tensor)",
    _normalization,
    _gradients,
    _plainly,
    num_differentiable=2,
).forward


def _scaling(
    mean: Tensor, variance: Tensor, scale: Tensor, shift: Tensor, eps: float
) -> tuple[Tensor, Tensor]:
    """Factors and offsets ``(B or 1, C)`` by which values are normalised."""
    factor = (variance + eps).rsqrt() * scale
    return factor, shift - mean * factor


def _moments(values: list[Tensor], per_sample: bool) -> tuple[Tensor, Tensor]:
    """Mean and biased variance ``(B or 1, C)`` of both kinds of rectangles together, ``(B, places, C)`` each."""
    over, number = ((1,) if per_sample else (0, 1)), _number(values, per_sample)
    chunks = []
    for x in values:
        sums, squares = _per_chunk(x), _per_chunk(x)
        torch.ops.sphericalvision.chunk_moments(x, sums, squares)
        sizes = sums.new_full((sums.shape[1], 1), CHUNK)
        sizes[-1] = x.shape[1] - CHUNK * (len(sizes) - 1)
        chunks.append((sums, squares, sizes))
    mean = torch.stack([sums.sum(over) for sums, _, _ in chunks]).sum(0) / number
    mean = mean.view(-1, values[0].shape[-1])
    # Squares about the mean of each chunk, and those of the chunks' means about that of all: rounding takes nothing.
    variances = [
        (squares + (sums / sizes - mean[:, None]).square() * sizes).sum(over)
        for sums, squares, sizes in chunks
    ]
    return mean, torch.stack(variances).sum(0).view_as(mean) / number


def _number(values: list[Tensor], per_sample: bool) -> int:
    """Places that statistics are of."""
    return sum(x.shape[1] * (1 if per_sample else len(x)) for x in values)


def _per_chunk(values: Tensor) -> Tensor:
    batch, places, channels = values.shape
    return values.new_empty(batch, -(-places // CHUNK), channels)


def _places(crown: Sequence[Tensor]) -> list[Tensor]:
    """Rectangles ``(B, 5, N, h, w, C)`` of both kinds as ``(B, places, C)`` each, contiguous; views where they are."""
    return [x.flatten(1, -2).contiguous() for x in crown]
