# SPDX-License-Identifier: Apache-2.0
"""Convolutions with a hexagon's seven taps as operators of torch, computed in C++, for any number of channels.

``hex_convolution.cpp`` takes Winograd's algorithms along every dimension: F(3, 3) along rows and columns, of whose 25
products for nine results two are zero because two corners of the kernel are, and F(4, 3) along the hypotheses. A
result then takes 2.6 products in place of 9 of a planar convolution, or 3.8 in place of 27. Borders are repeated while
reading, not copied around, and nothing but results leaves the cache.

The points of F(4, 3) are 0, +-1 / sqrt(2), +-sqrt(2) and infinity, as with the usual +-1 and +-2 in several dimensions
the largest errors would be several times as large; those of F(3, 3) are 0, 1, -1, 2 and infinity.

References:
    Winograd (1980), "Arithmetic complexity of computations"; Lavin and Gray (2016), "Fast algorithms for convolutional
    neural networks", for F(4, 3); Barabasz et al. (2020), "Error analysis and improving the accuracy of Winograd
    convolution for deep neural networks", for the choice of points.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from sphericalvision.crown.fast.double_backward import reference_gradients
from sphericalvision.crown.fast.registering import register_operator
from sphericalvision.crown.taps import COL_TAPS, ROW_TAPS, Taps, convolve, planar_kernel

__all__ = ["hex_convolution"]

_A, _B = math.sqrt(0.5), math.sqrt(2.0)

# From three taps along a line to factors of F(3, 3) and of F(4, 3). The transforms of values are in winograd_lines.h.
_PLANE_TAPS = (
    (1 / 2, 0.0, 0.0),
    (-1 / 2, -1 / 2, -1 / 2),
    (-1 / 6, 1 / 6, -1 / 6),
    (1 / 6, 1 / 3, 2 / 3),
    (0.0, 0.0, 1.0),
)
_LINE_TAPS = (
    (1.0, 0.0, 0.0),
    (-2 / 3, -2 / 3 * _A, -1 / 3),
    (-2 / 3, 2 / 3 * _A, -1 / 3),
    (1 / 6, _B / 6, 1 / 3),
    (1 / 6, -_B / 6, 1 / 3),
    (0.0, 0.0, 1.0),
)


def _convolution(
    images: Tensor, weight: Tensor, bias: Tensor | None, across: bool, border: bool, relu: bool
) -> Tensor:
    """Convolve rectangles or charts of one kind, differentiable any number of times.

    Args:
        images: ``(B, C, h, w)``, or volumes ``(B, C, N, h, w)``, whose first and last hypothesis is repeated.
        weight: ``(O, C, 7)``, or ``(O, C, 21)`` for volumes, index ``7 * depth + tap``.
        bias: ``(O,)``.
        across: whether they are row rectangles.
        border: whether the images have a border of one more place all around; otherwise theirs is repeated.
        relu: whether the results are rectified.

    Returns:
        ``(B, O, [N,] h, w)``, channels next to each other in memory.
    """
    result = _new_result(images, weight, border)
    given, factors, shift = (
        _volumes(images),
        _factors(weight, across),
        bias if bias is None else bias.contiguous(),
    )
    _operators().hex_convolve(given, factors, shift, relu, int(border), _volumes(result))
    return result


def _backward(
    gradient: Tensor, images: Tensor, weight: Tensor, across: bool, border: bool, wanted: list[bool]
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of images, weight and bias, those not ``wanted`` empty: the adjoints of all steps, in reverse."""
    given, upstream = _volumes(images), _volumes(gradient)
    grad_images, grad_weight, grad_bias = _new_gradients(images, weight, wanted)
    if wanted[0]:
        factors, grad_given = _factors(weight, across, adjoint=True), _volumes(grad_images.zero_())
        _operators().hex_convolve_backward_given(upstream, factors, int(border), grad_given)
    if wanted[1]:
        line, plane = _transforms(across, weight.shape[-1] // 7, weight.dtype)
        out, channels, _ = weight.shape
        # A part for every thread, added up in the end in the same order.
        parts = weight.new_zeros(
            torch.get_num_threads(), len(line), len(plane), channels, out + -out % _lanes()
        )
        _operators().hex_convolve_backward_weight(given, upstream, int(border), parts)
        by_factor = (parts[0] if len(parts) == 1 else parts.sum(0)).flatten(2)  # the adjoint of `_factors`
        by_tap = line.T @ torch.bmm(plane.T.expand(len(line), -1, -1), by_factor).flatten(1)
        grad_weight.copy_(by_tap.view(-1, channels, parts.shape[-1])[..., :out].permute(2, 1, 0))
    if wanted[2]:
        torch.sum(upstream, (0, 1, 2, 3), out=grad_bias)
    return grad_images, grad_weight, grad_bias


def _keep(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    images, weight, _, across, border, relu = inputs
    ctx.save_for_backward(images, weight, output if relu else None)
    ctx.options = across, border


def _gradients(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
    images, weight, rectified = ctx.saved_tensors
    if rectified is not None:
        gradient = torch.ops.aten.threshold_backward(gradient, rectified, 0)
    wanted = list(ctx.needs_input_grad[:3])
    found = hex_convolution_backward(gradient, images, weight, *ctx.options, wanted)
    return *(one if want else None for one, want in zip(found, wanted, strict=True)), None, None, None


def _keep_backward(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    ctx.save_for_backward(*inputs[:3])
    ctx.options = inputs[3:]


def _second_gradients(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
    """Of the gradients once more, by the reference: rare, so that no operators are written for them."""
    across, border, wanted = ctx.options

    def first_gradients(gradient: Tensor, images: Tensor, weight: Tensor) -> tuple[Tensor, ...]:
        bias = weight.new_zeros(len(weight)).requires_grad_()
        result = convolve(images, weight, _taps(across), bias, border=border)
        return torch.autograd.grad(result, (images, weight, bias), gradient, create_graph=True)

    some = [number for number, want in enumerate(wanted) if want]
    found = reference_gradients(
        lambda *inputs: tuple(first_gradients(*inputs)[number] for number in some),
        ctx.saved_tensors,
        ctx.needs_input_grad[:3],
        *(upstream[number] for number in some),
    )
    return *found, None, None, None


hex_convolution = register_operator(
    "hex_convolution(Tensor images, Tensor weight, Tensor? bias, bool across, bool border, bool relu) -> Tensor",
    _convolution,
    lambda images, weight, bias, across, border, relu: _new_result(images, weight, border),
    _gradients,
    _keep,
)
hex_convolution_backward = register_operator(
    "hex_convolution_backward(Tensor gradient, Tensor images, Tensor weight, bool across, bool border, bool[3] wanted) "
    "-> (Tensor, Tensor, Tensor)",
    _backward,
    lambda gradient, images, weight, across, border, wanted: _new_gradients(images, weight, wanted),
    _second_gradients,
    _keep_backward,
)


def _operators() -> Any:
    return torch.ops.sphericalvision


def _lanes() -> int:
    """Channels of a vector, up to a multiple of which the last dimension of factors is filled."""
    return int(_operators().lanes())


def _taps(across: bool) -> Taps:
    return ROW_TAPS if across else COL_TAPS


def _factors(weight: Tensor, across: bool, adjoint: bool = False) -> Tensor:
    """A weight as factors of products, ``(1 or 6, 23, in, out)``, for the convolution or its ``adjoint``.

    First along the hypotheses, then in the plane: a sixth of the arithmetic of one product with both.
    """
    line, plane = _transforms(across, weight.shape[-1] // 7, weight.dtype)
    by_tap = weight.permute((2, 0, 1) if adjoint else (2, 1, 0))
    by_tap = F.pad(by_tap, (0, -by_tap.shape[-1] % _lanes())).contiguous()
    by_plane = line @ by_tap.view(line.shape[1], -1)
    factors = torch.bmm(plane.expand(len(line), -1, -1), by_plane.view(len(line), 7, -1))
    return factors.view(len(line), len(plane), *by_tap.shape[1:])


@lru_cache(maxsize=8)
@torch.inference_mode(False)  # kept for training, too
def _transforms(across: bool, depth: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """From taps to factors along the hypotheses, ``(1 or 6, depth)``, and in the plane, ``(23, 7)``, on the CPU."""

    def table(rows: tuple[tuple[float, ...], ...]) -> Tensor:
        return torch.tensor(rows, dtype=torch.float64, device="cpu")

    line, plane = table(_LINE_TAPS if depth > 1 else ((1.0,),)), table(_PLANE_TAPS)
    # Every tap by itself as a planar kernel (7, 3, 3), of which the first and the last place are none.
    single = planar_kernel(torch.eye(7, dtype=torch.float64, device="cpu"), _taps(across))
    slots = torch.einsum("ri,sj,tij->rst", plane, plane, single).flatten(0, 1)[
        1:-1
    ]  # the others are always zero
    return line.to(dtype), slots.to(dtype)


def _volumes(images: Tensor) -> Tensor:
    """View ``(B, C, [N,] h, w)`` as ``(B, N, h, w, C)``, channels next to each other in memory."""
    volumes = (images.unsqueeze(2) if images.ndim == 4 else images).movedim(1, -1)
    return volumes if volumes.stride(-1) == 1 else volumes.contiguous()


def _new(shape: tuple[int, ...], like: Tensor) -> Tensor:
    """An uninitialised tensor ``(B, C, *)`` whose channels lie next to each other in memory."""
    batch, channels, *places = shape
    return like.new_empty(batch, *places, channels).movedim(-1, 1)


def _new_result(images: Tensor, weight: Tensor, border: bool) -> Tensor:
    batch, _, *middle, height, width = images.shape
    return _new((batch, len(weight), *middle, height - 2 * border, width - 2 * border), images)


def _new_gradients(images: Tensor, weight: Tensor, wanted: list[bool]) -> tuple[Tensor, Tensor, Tensor]:
    return (
        _new(tuple(images.shape), images) if wanted[0] else images.new_empty(0),
        weight.new_empty(weight.shape) if wanted[1] else weight.new_empty(0),
        weight.new_empty(len(weight)) if wanted[2] else weight.new_empty(0),
    )
