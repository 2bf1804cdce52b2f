# SPDX-License-Identifier: Apache-2.0
"""Volumes convolved 3 x 3 x 3 with a third of the multiplications: Winograd's F(4, 3) along the hypotheses.

Four neighbouring outputs need six products in place of twelve, each of them a planar convolution, for which
``winograd_rows`` has a short way of its own. What is left are convolutions with kernels of a single row, which run at
the speed of the machine; the sums around them are a few passes over memory.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sphericalvision.crown.fast.double_backward import reference_gradients
from sphericalvision.crown.fast.policy import forced
from sphericalvision.crown.fast.winograd_rows import (
    ALL_TAPS,
    PlanarKernel,
    add_gradient_of_rows,
    convolve_rows,
    planar_kernel,
    row_kernel_gradient,
)
from sphericalvision.crown.fast.workspace import Workspace, workspace

__all__ = [
    "adjoint_kernels",
    "conv3d_winograd",
    "convolve_padded",
    "convolve_padded_backward",
    "kernel_gradient",
    "repeat_border",
    "transformed_kernels",
    "unpadded",
    "winograd_pays",
]

MIN_CHANNELS = 32
"""Below, the sums around the products cost more than the products saved."""

MIN_CHANNELS_SMALL = 48
"""The same on small icospheres, where direct convolutions find all that they need in cache."""

LARGE = 10_000
"""Icospheres of fewer vertices are small: up to level 4."""

TRANSFORM_BYTES = 6 << 20
"""Tiles are taken through the transforms a few at a time, each of which takes no more than this: they stay in cache."""

# F(4, 3) computes four neighbouring results of a convolution with three taps from six products instead of twelve.
# A line of six given values d and one of three taps g are taken to six places each, multiplied place by place, and
# taken to four results:  y = RESULT @ ((TAPS @ g) * (GIVEN @ d)), Lavin and Gray's A^T [(G g) * (B^T d)].
# Values and taps are polynomials here, evaluated at the points 0, 1, -1, 2, -2 and infinity; a product of polynomials
# is a product of their values at each point, and RESULT interpolates it (transposed: a convolution reads backwards).
_GIVEN = (
    (4.0, 0.0, -5.0, 0.0, 1.0, 0.0),
    (0.0, -4.0, -4.0, 1.0, 1.0, 0.0),
    (0.0, 4.0, -4.0, -1.0, 1.0, 0.0),
    (0.0, -2.0, -1.0, 2.0, 1.0, 0.0),
    (0.0, 2.0, -1.0, -2.0, 1.0, 0.0),
    (0.0, 4.0, 0.0, -5.0, 0.0, 1.0),
)
_TAPS = (
    (1 / 4, 0.0, 0.0),
    (-1 / 6, -1 / 6, -1 / 6),
    (-1 / 6, 1 / 6, -1 / 6),
    (1 / 24, 1 / 12, 1 / 6),
    (1 / 24, -1 / 12, 1 / 6),
    (0.0, 0.0, 1.0),
)
_RESULT = (
    (1.0, 1.0, 1.0, 1.0, 1.0, 0.0),
    (0.0, 1.0, -1.0, 2.0, -2.0, 0.0),
    (0.0, 1.0, 1.0, 4.0, 4.0, 0.0),
    (0.0, 1.0, -1.0, 8.0, -8.0, 1.0),
)


def winograd_pays(
    volumes: Float[Tensor, " ..."], vertices: int, channels: int, out_channels: int, native: bool = False
) -> bool:
    """Whether Winograd's way is the faster one: float32 on a CPU, four hypotheses or more, and channels enough.

    Args:
        volumes: ``(B, C, N, *)``.
        vertices: of the icosphere that they are on.
        channels: of a convolution.
        out_channels: of its result.
        native: whether operators in C++ convolve, which pay for fewer channels.
    """
    if volumes.device.type != "cpu" or torch.is_autocast_enabled("cpu"):
        return False
    least = MIN_CHANNELS if native or vertices >= LARGE else MIN_CHANNELS_SMALL
    wide = min(channels, out_channels) >= least
    return forced() or (wide and volumes.dtype == torch.float32 and volumes.shape[2] >= 4)


def conv3d_winograd(
    volumes: Float[Tensor, "B C N h w"],
    kernel: Float[Tensor, "O C 3 3 3"],
    bias: Float[Tensor, " O"] | None = None,
    taps: Sequence[int] = ALL_TAPS,
) -> Float[Tensor, "B O N h w"]:
    """Convolve volumes ``(B, C, N, h, w)`` with ``(O, C, 3, 3, 3)``, continued by their own border values.

    Only the volumes are kept for the backward pass, not their transforms. In single precision the result is within
    1e-5 of the largest value of the direct sum.

    Args:
        volumes: ``(B, C, N, h, w)``.
        kernel: ``(O, C, 3, 3, 3)``.
        bias: ``(O,)``.
        taps: of the nine in the plane those that are not zero; others may be left without a gradient.

    References:
        Winograd (1980), "Arithmetic complexity of computations"; Lavin and Gray (2016), "Fast algorithms for
        convolutional neural networks", for F(4, 3).

    Examples:
        >>> conv3d_winograd(torch.ones(1, 2, 4, 5, 3), torch.ones(1, 2, 3, 3, 3)).round().unique()
        tensor([54.])
    """
    result: Tensor = _Winograd.apply(volumes, kernel, bias, tuple(taps))
    return result


def _convolve(volumes: Tensor, kernel: Tensor, bias: Tensor | None) -> Tensor:
    return F.conv3d(F.pad(volumes, (1, 1, 1, 1, 1, 1), mode="replicate"), kernel, bias)


class _Winograd(torch.autograd.Function):
    """Volumes, kernel and bias to convolved volumes."""

    @staticmethod
    def forward(volumes: Tensor, kernel: Tensor, bias: Tensor | None, taps: tuple[int, ...]) -> Tensor:
        padded, (batch, _, count, height, width) = _padded(volumes), volumes.shape
        result = volumes.new_empty(batch, count + -count % 4, height, width, len(kernel))
        convolve_padded(padded, transformed_kernels(kernel, taps), bias, result, workspace())
        return result[:, :count].movedim(-1, 1)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs[:3])
        ctx.taps = inputs[3]

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        volumes, kernel, bias = ctx.saved_tensors
        if torch.is_grad_enabled():
            inputs, needed = (volumes, kernel, bias), ctx.needs_input_grad[:3]
            return *reference_gradients(_convolve, inputs, needed, gradient), None
        want_volumes, want_kernel, want_bias, _ = ctx.needs_input_grad
        count = volumes.shape[2]
        grad_result = F.pad(gradient.movedim(1, -1), (0, 0, 2, 2, 2, 2, 0, -count % 4))
        padded = _padded(volumes, slack=2)
        batch, full, height, width, channels = padded.shape
        grad_padded = (
            grad_result.new_zeros(batch, full, height - 2, width - 2, channels) if want_volumes else None
        )
        grad_kernels = kernel.new_zeros(6, 4, 3, *kernel.shape[:2]) if want_kernel else None
        kernels = adjoint_kernels(kernel, ctx.taps)
        convolve_padded_backward(
            grad_result, padded, kernels, grad_padded, grad_kernels, workspace(), ctx.taps
        )
        grad_volumes = None if grad_padded is None else unpadded(grad_padded, count).movedim(-1, 1)
        grad_kernel = None if grad_kernels is None else kernel_gradient(grad_kernels).unflatten(-1, (3, 3))
        return grad_volumes, grad_kernel, gradient.sum((0, 2, 3, 4)) if want_bias else None, None


def convolve_padded(
    padded: Float[Tensor, "B N_padded h_padded w_padded C"],
    kernels: list[PlanarKernel],
    bias: Float[Tensor, " O"] | None,
    result: Float[Tensor, "B N h w O"],
    workspace: Workspace,
    rectify: bool = False,
) -> None:
    """Convolve padded volumes ``(B, N + 2, h + 2, w + 2, C)``, N a multiple of four, into ``(B, N, h, w, O)``.

    Args:
        padded: with the values around that the result needs; contiguous.
        kernels: ``transformed_kernels``.
        bias: ``(O,)``.
        result: overwritten; any strides.
        workspace: of these convolutions.
        rectify: whether a ReLU follows.
    """
    for given, slab in _slabs(padded, result):
        tiles = _transformed_tiles(given, workspace)
        products = workspace.take("products", (len(tiles), 6, *slab.shape[2:]), slab)
        for place, kernel in enumerate(kernels):  # the second product is part of every output, times one
            convolve_rows(
                tiles[:, place], kernel, bias if place == 1 else None, products[:, place], workspace
            )
        if slab.is_contiguous():
            _matmul(_RESULT, products, slab.unflatten(1, (-1, 4)).flatten(0, 1))
        else:
            values = workspace.take("results", slab.shape, slab)
            _matmul(_RESULT, products, values.unflatten(1, (-1, 4)).flatten(0, 1))
            slab.copy_(values)
        if rectify:
            slab.relu_()


def convolve_padded_backward(
    grad_result: Float[Tensor, "B N _ _ O"],
    padded: Float[Tensor, "B N_padded h_padded w_padded C"],
    kernels: list[PlanarKernel],
    grad_padded: Float[Tensor, "B N_padded _ _ C"] | None,
    grad_kernels: Float[Tensor, "6 4 3 O C"] | None,
    workspace: Workspace,
    taps: Sequence[int] = ALL_TAPS,
) -> None:
    """The adjoint of ``convolve_padded``; adds to ``grad_padded`` and ``grad_kernels``, where they are given.

    Both gradients are made of products that are fast on a CPU: planar convolutions of what is padded already, and
    matrix products between two views of the same grid, shifted.

    Args:
        grad_result: ``(B, N, h + 4, w + 4, O)``, zero on the two outermost places all around; contiguous.
        padded: ``(B, N + 2, h + 4, w + 4, C)``, what was convolved and then two rows and columns that are finite;
            contiguous.
        kernels: ``adjoint_kernels``.
        grad_padded: ``(B, N + 2, h + 2, w + 2, C)``.
        grad_kernels: ``(6, 4, 3, O, C)``, of the transformed kernels; see ``kernel_gradient``.
        workspace: of these convolutions.
        taps: of the nine in the plane those that are not zero, whose gradient is wanted.
    """
    to_products = tuple(zip(*_RESULT, strict=True))
    first = 0
    for given, slab in _slabs(padded, grad_result):
        grad_products = workspace.take(
            "grad_products", (slab[:, ::4].flatten(0, 1).shape[0], 6, *slab.shape[2:]), slab
        )
        for place, group in enumerate(slab):
            sized = grad_products.unflatten(0, (len(slab), -1))[place]
            _matmul(to_products, group.unflatten(0, (-1, 4)), sized)
        if grad_kernels is not None:
            tiles = _transformed_tiles(given, workspace)
            for place in range(6):
                add_gradient_of_rows(
                    grad_products[:, place], tiles[:, place], taps, grad_kernels[place], workspace
                )
        if grad_padded is not None:
            last = first + slab.shape[1]
            _add_gradient_of_tiles(grad_products, kernels, grad_padded[:, first : last + 2], workspace)
            first = last


def _slabs(padded: Tensor, result: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield volumes ``(B, 4 T + 2, *)`` and results ``(B, 4 T, *)``, so many tiles T at a time as stay in cache."""
    count = result.shape[1]
    at_most = max(1, TRANSFORM_BYTES // (padded[:, 0].numel() * padded.element_size()))
    tiles = count // 4
    together = -(-tiles // -(-tiles // at_most))  # as even as can be
    for first in range(0, count, 4 * together):
        last = min(first + 4 * together, count)
        yield padded[:, first : last + 2], result[:, first:last]


def _matmul(matrix: Sequence[Sequence[float]], values: Tensor, out: Tensor) -> None:
    """Multiply a matrix ``(p, q)`` with values ``(B, q, *)`` into ``(B, p, *)``, contiguous in all but B."""
    factor = values.new_tensor(matrix).expand(len(values), -1, -1)
    if torch.compiler.is_compiling():
        out.copy_((factor @ values.flatten(2)).view(out.shape))
    else:
        torch.bmm(factor, values.flatten(2), out=out.flatten(2))


def _transformed_tiles(padded: Tensor, workspace: Workspace) -> Tensor:
    """The six transforms of all tiles of ``(B, 4 T + 2, H, W, C)``: ``(B * T, 6, H, W, C)``."""
    batch, length, *image = padded.shape
    tiles = workspace.take("tiles", (batch, length // 4, 6, *image), padded)
    for volume, transformed in zip(padded, tiles, strict=True):
        overlapping = volume.flatten(1).unfold(0, 6, 4).mT
        _matmul(_GIVEN, overlapping, transformed.flatten(2))
    return tiles.flatten(0, 1)


def _add_gradient_of_tiles(
    grad_products: Tensor, kernels: list[PlanarKernel], grad_padded: Tensor, workspace: Workspace
) -> None:
    """Add to ``grad_padded`` ``(B, 4 T + 2, h, w, C)`` what follows from ``(B * T, 6, h + 2, w + 2, O)``."""
    batch, length, *image = grad_padded.shape
    grad_tiles = workspace.take("grad_tiles", (len(grad_products), 6, *image), grad_padded)
    for place, kernel in enumerate(kernels):
        convolve_rows(grad_products[:, place], kernel, None, grad_tiles[:, place], workspace)
    summed = workspace.take("tiles", grad_tiles.shape, grad_padded)
    _matmul(tuple(zip(*_GIVEN, strict=True)), grad_tiles, summed)
    grad_given = summed.unflatten(0, (batch, -1)).unbind(2)
    for place, values in enumerate(grad_given):
        grad_padded[:, place : place + length - 2 : 4] += values


def kernel_gradient(grad_kernels: Float[Tensor, "6 4 3 O C"]) -> Float[Tensor, "O C 3 9"]:
    """Gradient ``(O, C, 3, 9)`` of a kernel from that of its transforms ``(6, 4, 3, O, C)``."""
    return torch.einsum("kd,ktoc->ocdt", grad_kernels.new_tensor(_TAPS), row_kernel_gradient(grad_kernels))


def _padded(volumes: Tensor, slack: int = 0) -> Tensor:
    """Border values repeated all around, N filled up to a multiple of four: ``(B, N' + 2, h + 2, w + 2, C)``.

    With ``slack`` as many rows and columns of zeros after them.
    """
    batch, channels, count, height, width = volumes.shape
    full = count + -count % 4
    padded = volumes.new_empty(batch, full + 2, height + 2 + slack, width + 2 + slack, channels)
    if slack:
        padded[:, :, -slack:] = 0
        padded[:, :, :, -slack:] = 0
    with_border = padded[:, :, : height + 2, : width + 2]
    with_border[:, 1 : count + 1, 1:-1, 1:-1] = volumes.movedim(1, -1)
    repeat_border(with_border, count)
    return padded


def repeat_border(padded: Float[Tensor, "B N_padded h_padded w_padded C"], count: int) -> None:
    """Continue N = ``count`` volumes inside ``(B, N' + 2, h + 2, w + 2, C)`` by their own border values."""
    inner = padded[:, 1 : count + 1]
    inner[:, :, 0, 1:-1], inner[:, :, -1, 1:-1] = inner[:, :, 1, 1:-1], inner[:, :, -2, 1:-1]
    inner[:, :, :, 0], inner[:, :, :, -1] = inner[:, :, :, 1], inner[:, :, :, -2]
    padded[:, 0] = padded[:, 1]
    padded[:, count + 1 :] = padded[:, count : count + 1]


def unpadded(
    padded: Float[Tensor, "B N_padded h_padded w_padded C"], count: int
) -> Float[Tensor, "B N h w C"]:
    """The adjoint of ``repeat_border``: what was repeated is added to where it came from, ``(B, N, h, w, C)``."""
    padded[:, 1] += padded[:, 0]
    padded[:, count] += padded[:, count + 1 :].sum(1)
    inner = padded[:, 1 : count + 1]
    inner[:, :, :, 1] += inner[:, :, :, 0]
    inner[:, :, :, -2] += inner[:, :, :, -1]
    inner[:, :, 1] += inner[:, :, 0]
    inner[:, :, -2] += inner[:, :, -1]
    return inner[:, :, 1:-1, 1:-1]


def transformed_kernels(
    kernel: Float[Tensor, "O C 3 3 3"], taps: Sequence[int] = ALL_TAPS
) -> list[PlanarKernel]:
    """Six planar kernels ``(O, C, 3, 3)`` of one ``(O, C, 3, 3, 3)`` whose taps but those given are zero."""
    transformed = torch.einsum("kd,ocdij->kocij", kernel.new_tensor(_TAPS), kernel)
    return [planar_kernel(k, taps) for k in transformed]


def adjoint_kernels(kernel: Float[Tensor, "O C 3 3 3"], taps: Sequence[int] = ALL_TAPS) -> list[PlanarKernel]:
    """The six for the gradient of what is convolved."""
    return transformed_kernels(kernel.flip(3, 4).transpose(0, 1), [8 - tap for tap in taps])
