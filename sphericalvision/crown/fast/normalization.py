# SPDX-License-Identifier: Apache-2.0
"""Normalisation of a crown by its own statistics, and the ReLU after it, as an operator of torch, computed in C++.

Two passes over memory each way, where layers of torch take nine and sixteen. Kept for the backward pass are the
rectangles given and those returned, which the convolutions beside keep, too.

References:
    Ioffe and Szegedy (2015), "Batch normalization", for the gradient; Chan, Golub and LeVeque (1983), "Algorithms for
    computing the sample variance", for statistics of chunks.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from sphericalvision.crown.fast.double_backward import reference_gradients
from sphericalvision.crown.fast.registering import register_operator

__all__ = ["crown_normalization"]

CHUNK = 128
"""Places whose moments the operator takes at once; ``normalization.cpp`` has the same number."""


def _normalization(
    col: Tensor, row: Tensor, weight: Tensor, bias: Tensor, eps: float, per_sample: bool, relu: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Normalise rectangles by their own statistics, and rectify them, if asked for.

    Args:
        col: ``(B, 5, C, [N,] h, w)``.
        row: ``(B, 5, C, [N,] w, h)``.
        weight: ``(C,)``.
        bias: ``(C,)``.
        eps: added to the variance.
        per_sample: whether each sample has statistics of its own.
        relu: whether a ReLU follows.

    Returns:
        rectangles, channels next to each other in memory; and mean and biased variance, ``(B or 1, C)``, which are not
        differentiable.
    """
    values = [_places(rectangles) for rectangles in (col, row)]
    mean, variance = _moments(values, per_sample)
    factor = (variance + eps).rsqrt() * weight
    offset = bias - mean * factor
    results = [torch.empty_like(x) for x in values]
    for x, result in zip(values, results, strict=True):
        torch.ops.sphericalvision.scale_shift(x, factor, offset, relu, result)
    first, second = (_rectangles(x, like) for x, like in zip(results, (col, row), strict=True))
    return first, second, mean, variance


def _like_normalization(
    col: Tensor, row: Tensor, weight: Tensor, bias: Tensor, eps: float, per_sample: bool, relu: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    statistics = col.new_empty(len(col) if per_sample else 1, col.shape[2])
    return _new(col), _new(row), statistics, torch.empty_like(statistics)


def _backward(
    grad_col: Tensor,
    grad_row: Tensor,
    col: Tensor,
    row: Tensor,
    open_col: Tensor | None,
    open_row: Tensor | None,
    weight: Tensor,
    bias: Tensor,
    mean: Tensor,
    variance: Tensor,
    eps: float,
    per_sample: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Gradients of col, row, weight and bias.

    A place has a gradient of its own and, through mean and variance, a share of the sums of all places'. All in all
    that is, per channel, ``factor * gradient + by_value * value + constant``.
    """
    values, upstream = ([_places(x) for x in pair] for pair in ((col, row), (grad_col, grad_row)))
    open_at = [None if x is None else _places(x) for x in (open_col, open_row)]
    over = (1,) if per_sample else (0, 1)
    operators, invert = torch.ops.sphericalvision, (variance + eps).rsqrt()
    total, along = torch.zeros_like(mean), torch.zeros_like(mean)
    for g, x, y in zip(upstream, values, open_at, strict=True):
        totals = _per_chunk(x)
        products = torch.empty_like(totals)
        operators.gradient_sums(g, x, y, mean, totals, products)
        total += totals.sum(over)
        along += products.sum(over)
    along *= invert  # the sum of gradients times normalised values
    number = _number(values, per_sample)
    factor = invert * weight
    by_value = -factor * invert * along / number
    constant = -factor * total / number - by_value * mean
    found = [torch.empty_like(x) for x in values]
    for g, x, y, result in zip(upstream, values, open_at, found, strict=True):
        operators.normalized_gradient(g, x, y, factor, by_value, constant, result)
    first, second = (_rectangles(x, like) for x, like in zip(found, (col, row), strict=True))
    return first, second, along.sum(0), total.sum(0)


def _keep(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    *tensors, eps, per_sample, relu = inputs
    first, second, mean, variance = output
    ctx.mark_non_differentiable(mean, variance)
    ctx.save_for_backward(*tensors, mean, variance, *((first, second) if relu else (None, None)))
    ctx.options = eps, per_sample


def _gradients(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
    col, row, weight, bias, mean, variance, *rectified = ctx.saved_tensors
    upstream = gradients[:2]
    found = crown_normalization_backward(
        *upstream, col, row, *rectified, weight, bias, mean, variance, *ctx.options
    )
    return *found, None, None, None


def _keep_backward(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    *first, open_col, _, weight, bias, _, _, eps, per_sample = inputs
    ctx.save_for_backward(*first, weight, bias)
    ctx.options = eps, per_sample, open_col is not None


def _second_gradients(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
    """Of the gradients once more, by the plain formula."""

    def first_gradients(grad_col: Tensor, grad_row: Tensor, *inputs: Tensor) -> tuple[Tensor, ...]:
        col, row, weight, bias = inputs
        results = _plainly(col, row, weight, bias, *ctx.options)
        return torch.autograd.grad(results, inputs, (grad_col, grad_row), create_graph=True)

    needed = [*ctx.needs_input_grad[:4], *ctx.needs_input_grad[6:8]]
    found = reference_gradients(first_gradients, ctx.saved_tensors, needed, *upstream)
    return *found[:4], None, None, *found[4:], *(None,) * 4


def _like_backward(
    grad_col: Tensor, grad_row: Tensor, col: Tensor, row: Tensor, *others: Any
) -> tuple[Tensor, ...]:
    _, _, weight, bias, *_ = others
    return _new(col), _new(row), torch.empty_like(weight), torch.empty_like(bias)


crown_normalization = register_operator(
    "crown_normalization(Tensor col, Tensor row, Tensor weight, Tensor bias, float eps, bool per_sample, bool relu) "
    "-> (Tensor, Tensor, Tensor, Tensor)",
    _normalization,
    _like_normalization,
    _gradients,
    _keep,
)
crown_normalization_backward = register_operator(
    "crown_normalization_backward(Tensor grad_col, Tensor grad_row, Tensor col, Tensor row, Tensor? open_col, "
    "Tensor? open_row, Tensor weight, Tensor bias, Tensor mean, Tensor variance, float eps, bool per_sample) "
    "-> (Tensor, Tensor, Tensor, Tensor)",
    _backward,
    _like_backward,
    _second_gradients,
    _keep_backward,
)


def _plainly(
    col: Tensor, row: Tensor, weight: Tensor, bias: Tensor, eps: float, per_sample: bool, relu: bool
) -> tuple[Tensor, Tensor]:
    """The same in plain torch."""
    flat = torch.cat([_places(rectangles) for rectangles in (col, row)], 1)
    over = (1,) if per_sample else (0, 1)
    mean = flat.mean(over, keepdim=True)
    variance = (flat - mean).square().mean(over, keepdim=True)
    flat = (flat - mean) * (variance + eps).rsqrt() * weight + bias
    first, second = (flat.relu() if relu else flat).chunk(2, 1)
    return _rectangles(first, col), _rectangles(second, row)


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


def _places(rectangles: Tensor) -> Tensor:
    """Rectangles ``(B, 5, C, *)`` as ``(B, places, C)``, contiguous; a view where channels are innermost in memory."""
    return rectangles.movedim(2, -1).flatten(1, -2).contiguous()


def _rectangles(places: Tensor, like: Tensor) -> Tensor:
    """Undo ``_places``."""
    return places.view(like.movedim(2, -1).shape).movedim(-1, 2)


def _new(like: Tensor) -> Tensor:
    return like.new_empty(like.movedim(2, -1).shape).movedim(-1, 2)
