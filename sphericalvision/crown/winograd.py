# SPDX-License-Identifier: Apache-2.0
"""Volumes convolved 3 x 3 x 3 with a third of the multiplications: Winograd's F(4, 3) along the hypotheses.

Four neighbouring outputs need six products in place of twelve, each of them a planar convolution, for which
``winograd_rows`` has a short way of its own. What is left are convolutions with kernels of a single row, which run at
the speed of the machine; the sums around them are a few passes over memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from sphericalvision.crown.winograd_rows import (
    ALL_TAPS,
    PlanarKernel,
    add_gradient_of_rows,
    convolve_rows,
    of_rows,
    planar_kernel,
)

__all__ = [
    "conv3d_replicate",
    "conv3d_winograd",
    "convolve_padded",
    "convolve_padded_backward",
    "of_taps",
    "repeat_border",
    "transformed_kernels",
    "unpadded",
    "winograd_pays",
]

MIN_CHANNELS = 32
"""Below, the sums cost more than the products saved."""

TRANSFORM_BYTES = 6 << 20
"""Tiles are taken through the transforms a few at a time, each of which takes no more than this: they stay in cache."""

# Rows of the transform of three taps; its columns are the taps.
_TAPS = (
    (1 / 4, 0.0, 0.0),
    (-1 / 6, -1 / 6, -1 / 6),
    (-1 / 6, 1 / 6, -1 / 6),
    (1 / 24, 1 / 12, 1 / 6),
    (1 / 24, -1 / 12, 1 / 6),
    (0.0, 0.0, 1.0),
)


def winograd_pays(volumes: Tensor, kernel: Tensor) -> bool:
    """Whether ``conv3d_winograd`` is the faster way: single precision on a CPU, and channels enough."""
    wide = kernel.shape[1] >= MIN_CHANNELS and kernel.shape[0] >= MIN_CHANNELS
    return wide and volumes.dtype == torch.float32 and volumes.device.type == "cpu" and volumes.shape[2] >= 4


def conv3d_replicate(
    volumes: Tensor,
    kernel: Tensor,
    bias: Tensor | None = None,
    stride: int = 1,
    taps: Sequence[int] = ALL_TAPS,
) -> Tensor:
    """Convolve volumes ``(B, C, N, h, w)`` with ``(O, C, 3, 3, 3)``, continued by their own border values.

    Args:
        volumes: ``(B, C, N, h, w)``.
        kernel: ``(O, C, 3, 3, 3)``.
        bias: ``(O,)``.
        stride: in the plane; along N it is 1.
        taps: of the nine in the plane those that are not zero; others may be left without a gradient.

    Examples:
        >>> conv3d_replicate(torch.ones(1, 2, 4, 5, 3), torch.ones(1, 2, 3, 3, 3)).unique()
        tensor([54.])
    """
    if stride == 1 and winograd_pays(volumes, kernel):
        return conv3d_winograd(volumes, kernel, bias, taps)
    padded = F.pad(volumes, (1, 1, 1, 1, 1, 1), mode="replicate")
    return F.conv3d(padded, kernel, bias, (1, stride, stride))


def conv3d_winograd(
    volumes: Tensor, kernel: Tensor, bias: Tensor | None = None, taps: Sequence[int] = ALL_TAPS
) -> Tensor:
    """Do what ``conv3d_replicate`` does at stride 1, differentiable once.

    Only the volumes are kept for the backward pass, not their transforms. In single precision the result is within
    1e-5 of the largest value of the direct sum.

    References:
        Winograd (1980), "Arithmetic complexity of computations"; Lavin and Gray (2016), "Fast algorithms for
        convolutional neural networks", for F(4, 3).

    Examples:
        >>> volumes, kernel = torch.rand(1, 2, 6, 5, 3).double(), torch.rand(4, 2, 3, 3, 3).double()
        >>> torch.allclose(conv3d_winograd(volumes, kernel), conv3d_replicate(volumes, kernel))
        True
    """
    result: Tensor = _Winograd.apply(volumes, kernel, bias, tuple(taps))
    return result


class _Winograd(torch.autograd.Function):
    """Volumes, kernel and bias to convolved volumes."""

    @staticmethod
    def forward(volumes: Tensor, kernel: Tensor, bias: Tensor | None, taps: tuple[int, ...]) -> Tensor:
        padded, (batch, _, count, height, width) = _padded(volumes), volumes.shape
        result = volumes.new_empty(batch, count + -count % 4, height, width, len(kernel))
        convolve_padded(padded, transformed_kernels(kernel, taps), bias, result)
        return result[:, :count].movedim(-1, 1)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs[:2])
        ctx.taps = inputs[3]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        volumes, kernel = ctx.saved_tensors
        want_volumes, want_kernel, want_bias, _ = ctx.needs_input_grad
        count = volumes.shape[2]
        of_result = F.pad(gradient.movedim(1, -1), (0, 0, 2, 2, 2, 2, 0, -count % 4))
        padded = _padded(volumes, room=2)
        batch, full, height, width, channels = padded.shape
        of_padded = (
            of_result.new_zeros(batch, full, height - 2, width - 2, channels) if want_volumes else None
        )
        of_kernels = kernel.new_zeros(6, 4, 3, *kernel.shape[:2]) if want_kernel else None
        convolve_padded_backward(of_result, padded, kernel, of_padded, of_kernels, ctx.taps)
        of_volumes = None if of_padded is None else unpadded(of_padded, count).movedim(-1, 1)
        of_kernel = None if of_kernels is None else of_taps(of_kernels).unflatten(-1, (3, 3))
        return of_volumes, of_kernel, gradient.sum((0, 2, 3, 4)) if want_bias else None, None


def convolve_padded(padded: Tensor, kernels: list[PlanarKernel], bias: Tensor | None, result: Tensor) -> None:
    """Convolve padded volumes ``(B, N + 2, h + 2, w + 2, C)``, N a multiple of four, into ``(B, N, h, w, O)``.

    Args:
        padded: with the values around that the result needs; contiguous.
        kernels: ``transformed_kernels``.
        bias: ``(O,)``.
        result: overwritten; any strides.
    """
    biases = (None, bias, None, None, None, None)  # the second product is part of every output, times one
    tiles = result.shape[1] // 4
    together = max(1, TRANSFORM_BYTES // (padded[:, 0].numel() * padded.element_size()))
    for first in range(0, tiles, together):
        slab = padded[:, 4 * first : 4 * min(first + together, tiles) + 2]
        y = result[:, 4 * first : 4 * (first + together)].unflatten(1, (-1, 4))
        m0, m1, m2, m3, m4, m5 = (
            convolve_rows(tile, k, b).view(y[:, :, 0].shape)
            for tile, k, b in zip(_transformed_tiles(slab), kernels, biases, strict=True)
        )
        difference1, difference2 = m1 - m2, m3 - m4
        sum1, sum2 = m1.add_(m2), m3.add_(m4)
        y0, y1, y2, y3 = y.unbind(2)
        _sum_into(y0, sum1, sum2, 1).add_(m0)
        _sum_into(y1, difference1, difference2, 2)
        _sum_into(y2, sum1, sum2, 4)
        _sum_into(y3, difference1, difference2, 8).add_(m5)


def _sum_into(target: Tensor, first: Tensor, second: Tensor, factor: float) -> Tensor:
    """Write ``first + factor * second`` to ``target``; compilers want a copy for strided ones."""
    if torch.compiler.is_compiling():
        return target.copy_(torch.add(first, second, alpha=factor))
    return torch.add(first, second, alpha=factor, out=target)


def convolve_padded_backward(
    of_result: Tensor,
    padded: Tensor,
    kernel: Tensor,
    of_padded: Tensor | None,
    of_kernels: Tensor | None,
    taps: Sequence[int] = ALL_TAPS,
) -> None:
    """The adjoint of ``convolve_padded``; adds to ``of_padded`` and ``of_kernels``, where they are given.

    Both gradients are made of products that are fast on a CPU: planar convolutions of what is padded already, and
    matrix products between two views of the same grid, shifted.

    Args:
        of_result: ``(B, N, h + 4, w + 4, O)``, zero on the two outermost places all around; contiguous.
        padded: ``(B, N + 2, h + 4, w + 4, C)``, what was convolved and then two rows and columns that are finite.
        kernel: ``(O, C, 3, 3, 3)``.
        of_padded: ``(B, N + 2, h + 2, w + 2, C)``.
        of_kernels: ``(6, 4, 3, O, C)``, of the transformed kernels; see ``of_taps``.
        taps: of the nine in the plane those that are not zero, whose gradient is wanted.
    """
    tiles = of_result.shape[1] // 4
    kernels = transformed_kernels(kernel.flip(3, 4).transpose(0, 1), [8 - tap for tap in taps])
    together = max(1, TRANSFORM_BYTES // (padded[:, 0].numel() * padded.element_size()))
    for first in range(0, tiles, together):
        last = min(first + together, tiles)
        slab = padded[:, 4 * first : 4 * last + 2]
        y0, y1, y2, y3 = of_result[:, 4 * first : 4 * last].unflatten(1, (-1, 4)).unbind(2)
        even, odd, even4, odd8 = y0 + y2, y1 + y3, y0.add(y2, alpha=4), (2 * y1).add_(y3, alpha=8)
        products = (y0, even + odd, even.sub_(odd), even4 + odd8, even4.sub_(odd8), y3)
        of_tiles = []
        transformed = _transformed_tiles(slab) if of_kernels is not None else [None] * 6
        for place, (product, tile) in enumerate(zip(products, transformed, strict=True)):
            planes = product.flatten(0, 1)  # copies y0 and y3
            if of_padded is not None:
                of_tiles.append(convolve_rows(planes, kernels[place]))
            if of_kernels is not None and tile is not None:
                add_gradient_of_rows(planes, tile, taps, of_kernels[place])
        if of_padded is not None:
            _add_gradient_of_tiles(of_tiles, of_padded[:, 4 * first : 4 * last + 2])


def of_taps(of_kernels: Tensor) -> Tensor:
    """Gradient ``(O, C, 3, 9)`` of a kernel from that of its transforms ``(6, 4, 3, O, C)``."""
    return torch.einsum("kd,ktoc->ocdt", of_kernels.new_tensor(_TAPS), of_rows(of_kernels))


def _padded(volumes: Tensor, room: int = 0) -> Tensor:
    """Border values repeated all around, N filled up to a multiple of four: ``(B, N' + 2, h + 2, w + 2, C)``.

    With ``room`` as many rows and columns of zeros after them.
    """
    batch, channels, count, height, width = volumes.shape
    full = count + -count % 4
    padded = volumes.new_empty(batch, full + 2, height + 2 + room, width + 2 + room, channels)
    if room:
        padded[:, :, -room:] = 0
        padded[:, :, :, -room:] = 0
    with_border = padded[:, :, : height + 2, : width + 2]
    with_border[:, 1 : count + 1, 1:-1, 1:-1] = volumes.movedim(1, -1)
    repeat_border(with_border, count)
    return padded


def repeat_border(padded: Tensor, count: int) -> None:
    """Continue N = ``count`` volumes inside ``(B, N' + 2, h + 2, w + 2, C)`` by their own border values."""
    inner = padded[:, 1 : count + 1]
    inner[:, :, 0, 1:-1], inner[:, :, -1, 1:-1] = inner[:, :, 1, 1:-1], inner[:, :, -2, 1:-1]
    inner[:, :, :, 0], inner[:, :, :, -1] = inner[:, :, :, 1], inner[:, :, :, -2]
    padded[:, 0] = padded[:, 1]
    padded[:, count + 1 :] = padded[:, count : count + 1]


def unpadded(padded: Tensor, count: int) -> Tensor:
    """The adjoint of ``repeat_border``: what was repeated is added to where it came from, ``(B, N, h, w, C)``."""
    padded[:, 1] += padded[:, 0]
    padded[:, count] += padded[:, count + 1 :].sum(1)
    inner = padded[:, 1 : count + 1]
    inner[:, :, :, 1] += inner[:, :, :, 0]
    inner[:, :, :, -2] += inner[:, :, :, -1]
    inner[:, :, 1] += inner[:, :, 0]
    inner[:, :, -2] += inner[:, :, -1]
    return inner[:, :, 1:-1, 1:-1]


def _add_gradient_of_tiles(of_tiles: list[Tensor], of_padded: Tensor) -> None:
    """The adjoint of ``_transformed_tiles``, added to ``of_padded``."""
    v0, v1, v2, v3, v4, v5 = (g.unflatten(0, (len(of_padded), -1)) for g in of_tiles)
    difference1, difference2 = v1 - v2, v3 - v4
    sum1, sum2 = v1.add_(v2), v3.add_(v4)
    length = of_padded.shape[1] - 2
    at = [of_padded[:, place : place + length : 4] for place in range(6)]
    at[0].add_(v0, alpha=4)
    at[1].add_(v5, alpha=4).sub_(difference1, alpha=4).sub_(difference2, alpha=2)
    at[2].sub_(v0, alpha=5).sub_(sum1, alpha=4).sub_(sum2)
    at[3].sub_(v5, alpha=5).add_(difference1).add_(difference2, alpha=2)
    at[4].add_(sum1).add_(sum2).add_(v0)
    at[5].add_(v5)


def _transformed_tiles(padded: Tensor) -> Any:
    """Yield the six transforms of all tiles, each ``(B * N' / 4, h + 2, w + 2, C)``."""
    length = padded.shape[1] - 2
    d0, d1, d2, d3, d4, d5 = (padded[:, place : place + length : 4] for place in range(6))

    yield d4.add(d0, alpha=4).sub_(d2, alpha=5).flatten(0, 1)
    even, odd = d4.sub(d2, alpha=4), d3.sub(d1, alpha=4)
    yield (even + odd).flatten(0, 1)
    yield even.sub_(odd).flatten(0, 1)
    even, odd = d4 - d2, d3 - d1
    yield even.add(odd, alpha=2).flatten(0, 1)
    yield even.sub_(odd, alpha=2).flatten(0, 1)
    yield d5.add(d1, alpha=4).sub_(d3, alpha=5).flatten(0, 1)


def transformed_kernels(kernel: Tensor, taps: Sequence[int] = ALL_TAPS) -> list[PlanarKernel]:
    """Six planar kernels ``(O, C, 3, 3)`` of one ``(O, C, 3, 3, 3)`` whose taps but those given are zero."""
    transformed = torch.einsum("kd,ocdij->kocij", kernel.new_tensor(_TAPS), kernel)
    return [planar_kernel(k, taps) for k in transformed]
