# SPDX-License-Identifier: Apache-2.0
"""Volumes convolved 3 x 3 x 3 with half the multiplications: Winograd's F(4, 3) along the hypotheses.

Four neighbouring outputs need six products in place of twelve. What is left is six planar convolutions, which run at
the speed of the machine; the sums around them are a few passes over memory.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

__all__ = ["conv3d_replicate", "conv3d_winograd", "convolve_padded", "transformed_kernels", "winograd_pays"]

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


def conv3d_replicate(volumes: Tensor, kernel: Tensor, bias: Tensor | None = None, stride: int = 1) -> Tensor:
    """Convolve volumes ``(B, C, N, h, w)`` with ``(O, C, 3, 3, 3)``, continued by their own border values.

    Args:
        volumes: ``(B, C, N, h, w)``.
        kernel: ``(O, C, 3, 3, 3)``.
        bias: ``(O,)``.
        stride: in the plane; along N it is 1.

    Examples:
        >>> conv3d_replicate(torch.ones(1, 2, 4, 5, 3), torch.ones(1, 2, 3, 3, 3)).unique()
        tensor([54.])
    """
    if stride == 1 and winograd_pays(volumes, kernel):
        return conv3d_winograd(volumes, kernel, bias)
    padded = F.pad(volumes, (1, 1, 1, 1, 1, 1), mode="replicate")
    return F.conv3d(padded, kernel, bias, (1, stride, stride))


def conv3d_winograd(volumes: Tensor, kernel: Tensor, bias: Tensor | None = None) -> Tensor:
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
    result: Tensor = _Winograd.apply(volumes, kernel, bias)
    return result


class _Winograd(torch.autograd.Function):
    """Volumes, kernel and bias to convolved volumes."""

    @staticmethod
    def forward(volumes: Tensor, kernel: Tensor, bias: Tensor | None) -> Tensor:
        padded, (batch, _, count, height, width) = _padded(volumes), volumes.shape
        result = volumes.new_empty(batch, count + -count % 4, height, width, len(kernel))
        convolve_padded(padded, transformed_kernels(kernel), bias, result)
        return result[:, :count].movedim(-1, 1)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, Tensor | None], output: Tensor) -> None:
        ctx.save_for_backward(*inputs[:2])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        volumes, kernel = ctx.saved_tensors
        want_volumes, want_kernel, want_bias = ctx.needs_input_grad
        padded, count = _padded(volumes), volumes.shape[2]
        missing = -count % 4
        of_outputs = gradient.movedim(1, -1)
        if missing:
            of_outputs = F.pad(of_outputs, (0, 0, 0, 0, 0, 0, 0, missing))
        y0, y1, y2, y3 = (of_outputs[:, place::4] for place in range(4))
        even, odd, even4, odd8 = y0 + y2, y1 + y3, y0.add(y2, alpha=4), (2 * y1).add(y3, alpha=8)
        of_products = (y0, even + odd, even - odd, even4 + odd8, even4 - odd8, y3)
        of_tiles, of_kernels = [], []
        kernels = transformed_kernels(kernel)
        for tile, k, product in zip(_transformed_tiles(padded), kernels, of_products, strict=True):
            of_tile, of_kernel, _ = torch.ops.aten.convolution_backward(
                product.flatten(0, 1).movedim(-1, 1).contiguous(memory_format=torch.channels_last),
                tile,
                k,
                None,
                (1, 1),
                (0, 0),
                (1, 1),
                False,
                (0, 0),
                1,
                (want_volumes, want_kernel, False),
            )
            of_tiles.append(of_tile)
            of_kernels.append(of_kernel)
        of_volumes = _gradient_of_volumes(of_tiles, padded.shape, count) if want_volumes else None
        of_bias = gradient.sum((0, 2, 3, 4)) if want_bias else None
        if not want_kernel:
            return of_volumes, None, of_bias
        transform = kernel.new_tensor(_TAPS)
        return of_volumes, torch.einsum("kd,kocij->ocdij", transform, torch.stack(of_kernels)), of_bias


def convolve_padded(padded: Tensor, kernels: list[Tensor], bias: Tensor | None, result: Tensor) -> None:
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
            F.conv2d(tile, k, b).movedim(1, -1).view(y[:, :, 0].shape)
            for tile, k, b in zip(_transformed_tiles(slab), kernels, biases, strict=True)
        )
        difference1, difference2 = m1 - m2, m3 - m4
        sum1, sum2 = m1.add_(m2), m3.add_(m4)
        torch.add(sum1, sum2, out=y[:, :, 0]).add_(m0)
        torch.add(difference1, difference2, alpha=2, out=y[:, :, 1])
        torch.add(sum1, sum2, alpha=4, out=y[:, :, 2])
        torch.add(difference1, difference2, alpha=8, out=y[:, :, 3]).add_(m5)


def _padded(volumes: Tensor) -> Tensor:
    """Border values repeated all around, N filled up to a multiple of four: ``(B, N' + 2, h + 2, w + 2, C)``."""
    batch, channels, count, height, width = volumes.shape
    full = count + -count % 4
    padded = volumes.new_empty(batch, full + 2, height + 2, width + 2, channels)
    inner = padded[:, 1 : count + 1]
    inner[:, :, 1:-1, 1:-1] = volumes.movedim(1, -1)
    inner[:, :, 0, 1:-1], inner[:, :, -1, 1:-1] = inner[:, :, 1, 1:-1], inner[:, :, -2, 1:-1]
    inner[:, :, :, 0], inner[:, :, :, -1] = inner[:, :, :, 1], inner[:, :, :, -2]
    padded[:, 0] = padded[:, 1]
    padded[:, count + 1 :] = padded[:, count : count + 1]
    return padded


def _gradient_of_volumes(of_tiles: list[Tensor], shape: torch.Size, count: int) -> Tensor:
    """The adjoint of ``_transformed_tiles`` after ``_padded``."""
    v0, v1, v2, v3, v4, v5 = (g.movedim(1, -1).unflatten(0, (shape[0], -1)) for g in of_tiles)
    sum1, difference1, sum2, difference2 = v1 + v2, v1 - v2, v3 + v4, v3 - v4
    of_places = (
        4 * v0,
        (4 * v5).sub_(difference1, alpha=4).sub_(difference2, alpha=2),
        (-5 * v0).sub_(sum1, alpha=4).sub_(sum2),
        (-5 * v5).add_(difference1).add_(difference2, alpha=2),
        sum1.add_(sum2).add_(v0),
        v5,
    )
    padded = v0.new_zeros(shape)
    for place, of_place in enumerate(of_places):
        padded[:, place : place + shape[1] - 2 : 4] += of_place
    padded[:, 1] += padded[:, 0]
    padded[:, count] += padded[:, count + 1 :].sum(1)
    inner = padded[:, 1 : count + 1]
    inner[:, :, :, 1] += inner[:, :, :, 0]
    inner[:, :, :, -2] += inner[:, :, :, -1]
    inner[:, :, 1] += inner[:, :, 0]
    inner[:, :, -2] += inner[:, :, -1]
    return inner[:, :, 1:-1, 1:-1].movedim(-1, 1)


def _transformed_tiles(padded: Tensor) -> Any:
    """Yield the six transforms of all tiles, each ``(B * N' / 4, C, h + 2, w + 2)``, channels innermost."""
    length = padded.shape[1] - 2
    d0, d1, d2, d3, d4, d5 = (padded[:, place : place + length : 4] for place in range(6))

    def planes(tiles: Tensor) -> Tensor:
        return tiles.flatten(0, 1).movedim(-1, 1)

    yield planes(d4.add(d0, alpha=4).sub_(d2, alpha=5))
    even, odd = d4.sub(d2, alpha=4), d3.sub(d1, alpha=4)
    yield planes(even + odd)
    yield planes(even.sub_(odd))
    even, odd = d4 - d2, d3 - d1
    yield planes(even.add(odd, alpha=2))
    yield planes(even.sub_(odd, alpha=2))
    yield planes(d5.add(d1, alpha=4).sub_(d3, alpha=5))


def transformed_kernels(kernel: Tensor) -> list[Tensor]:
    """Six planar kernels ``(O, C, 3, 3)`` of one ``(O, C, 3, 3, 3)``, channels innermost."""
    transformed = torch.einsum("kd,ocdij->kocij", kernel.new_tensor(_TAPS), kernel)
    return [k.contiguous(memory_format=torch.channels_last) for k in transformed]
