# SPDX-License-Identifier: Apache-2.0
"""Two normalised 3D crown convolutions for training, one rectangle at a time in both passes.

Kept for the backward pass are the volumes given and what the two convolutions put out before normalisation. All else,
as normalised values, their copies with borders and transforms, is made again where it is wanted, in cache.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sphericalvision.crown.conv import COL_TAPS, ROW_TAPS, _planar_kernel, neighbor_taps
from sphericalvision.crown.fast.rectangles import PlaceSum, Rectangles, Some
from sphericalvision.crown.fast.winograd import (
    MIN_CHANNELS,
    adjoint_kernels,
    convolve_padded,
    convolve_padded_backward,
    of_taps,
    repeat_border,
    transformed_kernels,
    unpadded,
    winograd_pays,
)
from sphericalvision.crown.fast.winograd_cubes import CubeKernel, convolve_cubes, cube_kernel, cubes_pay
from sphericalvision.crown.fast.winograd_rows import PlanarKernel, Workspace
from sphericalvision.crown.layout import places_per_vertex
from sphericalvision.icosphere import level_from_num_vertices

__all__ = ["Moments", "NormedLayer", "block3d_pays", "crown_block3d"]

TAPS = (COL_TAPS, ROW_TAPS)


class NormedLayer(NamedTuple):
    """A convolution and the affine normalisation by batch statistics after it.

    Attributes:
        weight: ``(out, in, 21)``.
        scale: ``(out,)``; None for no normalisation.
        shift: ``(out,)``; None for no normalisation.
        eps: added to the variance.
    """

    weight: Tensor
    scale: Tensor | None = None
    shift: Tensor | None = None
    eps: float = 0.0


class Moments(NamedTuple):
    """Mean and biased variance ``(C,)`` over a number of places; not differentiable."""

    mean: Tensor
    variance: Tensor
    places: int


def block3d_pays(values: Tensor, weight: Tensor) -> bool:
    """Whether ``crown_block3d`` is the faster way for values ``(B, C, N, V)`` and a weight ``(out, in, 21)``."""
    return winograd_pays(values[:, :, :, None], weight)


def crown_block3d(
    values: Tensor, first: NormedLayer, second: NormedLayer, native: bool = False
) -> tuple[Tensor, list[Moments]]:
    """Convolve volumes, normalise, rectify, convolve, normalise, and exchange; differentiable once.

    The same as ``crown_conv3d`` and batch normalisation in training mode between ``to_crown`` and ``from_crown``, in
    less time and memory. Both convolutions are computed as by ``conv3d_winograd``.

    Args:
        values: ``(B, in, N, V)``.
        first: from in to hidden channels.
        second: from hidden to out channels; it may be without normalisation.
        native: whether the forward pass uses operators in C++; see ``crown_conv3d_chain``.

    Returns:
        ``(B, out, N, V)`` and the statistics of the normalisations, for running averages.

    References:
        Komatsu et al. (2020), CrownConv in three dimensions; Ioffe and Szegedy (2015), "Batch normalization", for
        the gradient.

    Examples:
        >>> layer = NormedLayer(torch.rand(2, 2, 21), torch.ones(2), torch.zeros(2), 1e-5)
        >>> result, _ = crown_block3d(torch.rand(1, 2, 4, 42), layer, layer)
        >>> result.shape
        torch.Size([1, 2, 4, 42])
    """
    rows = values.movedim(1, -1).contiguous()
    result, *statistics = _Block.apply(rows, *first, *second, native)
    batch, count, vertices, _ = rows.shape
    n = 2 ** level_from_num_vertices(vertices)
    places = batch * count * 10 * (2 * n + 1) * (n + 1)
    pairs = zip(statistics[::2], statistics[1::2], strict=True)
    return result.movedim(-1, 1), [Moments(mean, variance, places) for mean, variance in pairs]


class _Block(torch.autograd.Function):
    """Rows ``(B, N, V, in)`` to rows ``(B, N, V, out)``, and means and variances of both layers."""

    @staticmethod
    def forward(
        ctx: Any,
        rows: Tensor,
        weight1: Tensor,
        scale1: Tensor,
        shift1: Tensor,
        eps1: float,
        weight2: Tensor,
        scale2: Tensor | None,
        shift2: Tensor | None,
        eps2: float,
        native: bool,
    ) -> tuple[Tensor, ...]:
        geometry = _Geometry(rows)
        hidden, out = len(weight1), len(weight2)
        conv1, conv2 = geometry.outputs(hidden), geometry.outputs(out)
        workspace, moments = Workspace(), _Moments()

        native = native and cubes_pay(geometry.n)
        kernels = _ready(weight1, native)
        padded = geometry.padded(rows.shape[-1])
        for place, some, sample in geometry:
            given = geometry.take(sample, some, padded)
            result = geometry.view(conv1[place], some)
            _convolve(given, kernels[some.across], result, workspace)
            moments.add(result[:, : geometry.count])
        mean1, variance1 = moments.total()
        to_norm1 = _to_norm(mean1, (variance1 + eps1).rsqrt(), scale1, shift1)

        kernels = _ready(weight2, native)
        padded, moments = geometry.padded(hidden), _Moments()
        sums = [PlaceSum(sample.new_empty(*sample.shape[:2], out), geometry.n) for sample in rows]
        for place, some, _ in geometry:
            given = geometry.rectified(conv1[place], some, to_norm1, padded)
            result = geometry.view(conv2[place], some)
            _convolve(given, kernels[some.across], result, workspace)
            result = result[:, : geometry.count]
            sums[place // len(geometry.crown)].add(result, some)
            if scale2 is not None:
                moments.add(result)
        answer = _stack([total.mean() for total in sums])

        statistics = [mean1, variance1]
        kept = [rows, conv1, weight1, scale1, shift1, weight2, mean1, variance1]
        if scale2 is not None and shift2 is not None:
            mean2, variance2 = moments.total()
            statistics += mean2, variance2
            kept += conv2, scale2, mean2, variance2
            factor, offset = _to_norm(mean2, (variance2 + eps2).rsqrt(), scale2, shift2)
            answer = torch.addcmul(offset, answer, factor)
        ctx.save_for_backward(*kept)
        ctx.eps = eps1, eps2
        ctx.mark_non_differentiable(*statistics)
        return answer, *statistics

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        rows, conv1, weight1, scale1, shift1, weight2, mean1, variance1, *normed = ctx.saved_tensors
        invert1 = (variance1 + ctx.eps[0]).rsqrt()
        geometry, workspace = _Geometry(rows, room=True), Workspace()

        by_vertex = gradient * places_per_vertex(geometry.n, gradient).reciprocal_()[:, None]
        of_scale2 = of_shift2 = conv2 = by_output = None
        if normed:
            conv2, scale2, mean2, variance2 = normed
            invert2 = (variance2 + ctx.eps[1]).rsqrt()
            of_shift2 = gradient.sum((0, 1, 2))
            of_scale2 = torch.zeros_like(mean2)
            for place, some, sample in geometry.over(by_vertex):
                centered = geometry.view(conv2[place], some)[:, : geometry.count] - mean2
                of_scale2 += centered.mul_(geometry.take_inner(sample, some)).sum((0, 1, 2, 3))
            of_scale2 *= invert2
            by_output, constant = geometry.of_norm(mean2, invert2, scale2, of_scale2, of_shift2)
            torch.addcmul(constant, by_vertex, scale2 * invert2, out=by_vertex)

        to_norm1 = _to_norm(mean1, invert1, scale1, shift1)
        kernels, of_weight = _transformed(weight2, adjoint_kernels), _OfWeight(weight2)
        padded, of_padded = geometry.padded(len(weight1)), geometry.padded(len(weight1), room=False)
        of_outputs = geometry.outputs_with_zeros(len(weight2))
        of_norm1 = torch.empty_like(conv1)
        of_scale1, of_shift1 = torch.zeros_like(mean1), torch.zeros_like(mean1)
        for place, some, sample in geometry.over(by_vertex):
            given = geometry.rectified(conv1[place], some, to_norm1, padded)
            upstream = geometry.zero_bordered(of_outputs, some)
            inner = upstream[:, : geometry.count, 2:-2, 2:-2]
            inner.copy_(geometry.take_inner(sample, some))
            if conv2 is not None and by_output is not None:
                inner.addcmul_(geometry.view(conv2[place], some)[:, : geometry.count], by_output)
            target = geometry.without_room(of_padded, some).zero_()
            convolve_padded_backward(
                upstream,
                given,
                kernels[some.across],
                target,
                of_weight.sums[some.across],
                workspace,
                of_weight.taps[some.across],
            )
            of_normed = geometry.view(of_norm1[place], some)[:, : geometry.count]
            positive = given[:, 1 : geometry.count + 1, 1:-3, 1:-3] > 0
            torch.mul(unpadded(target, geometry.count), positive, out=of_normed)
            of_shift1 += of_normed.sum((0, 1, 2, 3))
            centered = geometry.view(conv1[place], some)[:, : geometry.count] - mean1
            of_scale1 += centered.mul_(of_normed).sum((0, 1, 2, 3))
        of_scale1 *= invert1
        of_weight2 = of_weight.total()

        by_output, constant = geometry.of_norm(mean1, invert1, scale1, of_scale1, of_shift1)
        kernels, of_weight = _transformed(weight1, adjoint_kernels), _OfWeight(weight1)
        padded = geometry.padded(rows.shape[-1])
        of_given = geometry.padded(rows.shape[-1], room=False) if ctx.needs_input_grad[0] else None
        of_outputs = geometry.outputs_with_zeros(len(weight1))
        sums = [PlaceSum(torch.empty_like(sample), geometry.n) for sample in rows]
        for place, some, sample in geometry:
            given = geometry.take(sample, some, padded)
            upstream = geometry.zero_bordered(of_outputs, some)
            inner = upstream[:, : geometry.count, 2:-2, 2:-2]
            of_normed, output = (
                geometry.view(both[place], some)[:, : geometry.count] for both in (of_norm1, conv1)
            )
            torch.addcmul(constant, of_normed, scale1 * invert1, out=inner).addcmul_(output, by_output)
            of_taken = None if of_given is None else geometry.without_room(of_given, some).zero_()
            convolve_padded_backward(
                upstream,
                given,
                kernels[some.across],
                of_taken,
                of_weight.sums[some.across],
                workspace,
                of_weight.taps[some.across],
            )
            if of_taken is not None:
                sums[place // len(geometry.crown)].add(unpadded(of_taken, geometry.count), some)
        of_rows = _stack([total.total() for total in sums]) if of_given is not None else None
        of_first = of_weight.total(), of_scale1, of_shift1, None
        return of_rows, *of_first, of_weight2, of_scale2, of_shift2, None, None


class _Geometry:
    """Where values of a batch ``(B, N, V, C)`` stand, and buffers of the right sizes.

    Iterating gives, for every group of rectangles of every sample, its number, its places and the sample ``(N, V, C)``.
    """

    def __init__(self, rows: Tensor, room: bool = False) -> None:
        self.rows, self.room = rows, room
        _, self.count, vertices, _ = rows.shape
        level = level_from_num_vertices(vertices)
        self.n = 2**level
        self.full = self.count + -self.count % 4
        self.crown = Rectangles(rows[0], level, self.full, room)
        self.groups = list(self.crown)

    def __iter__(self) -> Iterator[tuple[int, Some, Tensor]]:
        return self.over(self.rows)

    def over(self, values: Tensor) -> Iterator[tuple[int, Some, Tensor]]:
        """Iterate with samples of other values ``(B, N, V, *)``."""
        for place, (sample, some) in enumerate(product(values, self.groups)):
            yield place, some, sample

    def outputs(self, channels: int) -> Tensor:
        """What a convolution puts out: ``(groups of all samples, places of a group, channels)``."""
        return self.rows.new_empty(len(self.rows) * len(self.crown), self.crown.size, channels)

    def view(self, outputs: Tensor, some: Some) -> Tensor:
        """Outputs of one group as ``(g, N', h, w, C)``."""
        groups, depth, height, width = some.places.shape
        border = 4 if self.room else 2
        return outputs.view(groups, depth - 2, height - border, width - border, -1)

    def padded(self, channels: int, room: bool | None = None) -> Tensor:
        """A buffer for padded volumes of a group, all zero."""
        more = 2 if self.room and room is not False else 0
        size = self.crown.together * (self.full + 2) * (2 * self.n + 3 + more) * (self.n + 3 + more)
        return self.rows.new_zeros(size, channels)

    def outputs_with_zeros(self, channels: int) -> Tensor:
        """A buffer for outputs of a group with two rows and columns of zeros all around."""
        size = self.crown.together * self.full * (2 * self.n + 5) * (self.n + 5)
        return self.rows.new_zeros(2, size, channels)

    def zero_bordered(self, buffer: Tensor, some: Some) -> Tensor:
        """Its part for one group, ``(g, N', h + 4, w + 4, C)``; each direction has its own, so that zeros stay."""
        groups, depth, height, width = some.places.shape
        return buffer[int(some.across)].view(groups, depth - 2, height, width, -1)

    def without_room(self, buffer: Tensor, some: Some) -> Tensor:
        """A buffer as padded volumes ``(g, N' + 2, h + 2, w + 2, C)``."""
        groups, depth, height, width = some.places.shape
        return buffer.view(groups, depth, height - 2, width - 2, -1)

    def take(self, sample: Tensor, some: Some, buffer: Tensor) -> Tensor:
        """Padded volumes of one group."""
        torch.index_select(sample.view(-1, sample.shape[-1]), 0, some.places.flatten(), out=buffer)
        return buffer.view(*some.places.shape, -1)

    def take_inner(self, sample: Tensor, some: Some) -> Tensor:
        """Values of one group without borders, ``(g, N, h, w, C)``."""
        end = -3 if self.room else -1
        places = some.places[:, 1 : self.count + 1, 1:end, 1:end]
        taken = sample.view(-1, sample.shape[-1]).index_select(0, places.flatten())
        return taken.view(*places.shape, -1)

    def rectified(
        self, outputs: Tensor, some: Some, to_norm: tuple[Tensor, Tensor], buffer: Tensor
    ) -> Tensor:
        """Outputs of one group normalised, rectified and padded."""
        padded = buffer.view(*some.places.shape, -1)
        with_border = padded[:, :, :-2, :-2] if self.room else padded
        inner = with_border[:, 1 : self.count + 1, 1:-1, 1:-1]
        factor, offset = to_norm
        torch.addcmul(offset, self.view(outputs, some)[:, : self.count], factor, out=inner).relu_()
        repeat_border(with_border, self.count)
        return padded

    def of_norm(
        self, mean: Tensor, invert: Tensor, scale: Tensor, of_scale: Tensor, of_shift: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The gradient of a normalisation's input is ``scale * invert`` times that of its output, plus the input times
        the first, plus the second of these."""
        number = len(self.rows) * self.count * 10 * (2 * self.n + 1) * (self.n + 1)
        by_input = -scale * invert.square() * of_scale / number
        return by_input, -scale * invert * of_shift / number - by_input * mean


class _Moments:
    """Mean and biased variance of values ``(*, C)`` that come in groups of equal size."""

    def __init__(self) -> None:
        self.means: list[Tensor] = []
        self.variances: list[Tensor] = []

    def add(self, values: Tensor) -> None:
        """Count a group in."""
        values = values.flatten(0, -2)
        mean = values.mean(0)
        self.means.append(mean)
        self.variances.append((values - mean).square_().mean(0))

    def total(self) -> tuple[Tensor, Tensor]:
        """Those of all groups."""
        means = torch.stack(self.means)
        mean = means.mean(0)
        return mean, torch.stack(self.variances).mean(0) + (means - mean).square_().mean(0)


class _OfWeight:
    """The gradient of a weight ``(out, in, 21)``, gathered from both directions."""

    def __init__(self, weight: Tensor) -> None:
        self.weight = weight
        self.sums = [weight.new_zeros(6, 4, 3, *weight.shape[:2]) for _ in TAPS]
        self.taps = [neighbor_taps(taps) for taps in TAPS]

    def total(self) -> Tensor:
        of_weight = self.weight.new_zeros(*self.weight.shape[:2], 3, 8)
        for taps, sums in zip(TAPS, self.sums, strict=True):
            of_weight.index_add_(-1, torch.tensor(sum(taps, ()), device=sums.device), of_taps(sums))
        return of_weight[..., :7].flatten(-2)


Kernel = TypeVar("Kernel")


def _transformed(weight: Tensor, transform: Callable[..., Kernel]) -> list[Kernel]:
    """Kernels of both directions, made ready."""
    planar = [_planar_kernel(weight.unflatten(-1, (3, 7)), taps) for taps in TAPS]
    return [transform(kernel, neighbor_taps(taps)) for kernel, taps in zip(planar, TAPS, strict=True)]


def _ready(weight: Tensor, native: bool) -> list[CubeKernel] | list[list[PlanarKernel]]:
    """Kernels of both directions for a forward pass."""
    if native and len(weight) >= MIN_CHANNELS:
        return _transformed(weight, cube_kernel)
    return _transformed(weight, transformed_kernels)


def _convolve(
    padded: Tensor, kernel: CubeKernel | list[PlanarKernel], result: Tensor, workspace: Workspace
) -> None:
    if isinstance(kernel, CubeKernel):
        convolve_cubes(padded, kernel, None, result, workspace, native=True)
    else:
        convolve_padded(padded, kernel, None, result, workspace)


def _stack(samples: list[Tensor]) -> Tensor:
    """One tensor of all; without a copy if there is only one."""
    return samples[0][None] if len(samples) == 1 else torch.stack(samples)


def _to_norm(mean: Tensor, invert: Tensor, scale: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
    """Factor and offset that normalise."""
    factor = invert * scale
    return factor, shift - mean * factor
