# SPDX-License-Identifier: Apache-2.0
"""Two normalised 3D crown convolutions for training, a few rectangles at a time in both passes.

In plain layers the backward pass would keep, for every layer, crowns of all places with their borders. Here it keeps
the volumes given and what the two convolutions put out before normalisation, and nothing else: normalised values, ReLU,
copies with borders and Winograd's transforms are made again where they are wanted, a group of rectangles at a time, in
cache. That is less memory and, as memory is what these steps wait for, less time too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product
from typing import Any, NamedTuple, TypeVar

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sphericalvision.crown.fast.double_backward import reference_gradients
from sphericalvision.crown.fast.layout import places_per_vertex
from sphericalvision.crown.fast.rectangles import PlaceSum, RectangleGroup, Rectangles
from sphericalvision.crown.fast.winograd import (
    MIN_CHANNELS,
    adjoint_kernels,
    convolve_padded,
    convolve_padded_backward,
    kernel_gradient,
    repeat_border,
    transformed_kernels,
    unpadded,
)
from sphericalvision.crown.fast.winograd_cubes import CubeKernel, convolve_cubes, cube_kernel, cubes_pay
from sphericalvision.crown.fast.winograd_rows import PlanarKernel
from sphericalvision.crown.fast.workspace import Workspace, workspace
from sphericalvision.crown.places import places_per_vertex as plain_places_per_vertex
from sphericalvision.crown.places import sum_over_places, values_at_places
from sphericalvision.crown.taps import COL_TAPS, ROW_TAPS, convolve, neighbor_taps, planar_kernel
from sphericalvision.icosphere import level_from_num_vertices

__all__ = ["Moments", "NormedLayer", "convolve_block"]

TAPS = (COL_TAPS, ROW_TAPS)


class NormedLayer(NamedTuple):
    """A convolution and the affine normalisation by the statistics of its results after it.

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


def convolve_block(
    values: Float[Tensor, "B C N V"], first: NormedLayer, second: NormedLayer, native: bool = False
) -> tuple[Float[Tensor, "B O N V"], list[Moments]]:
    """Convolve volumes, normalise, rectify, convolve, normalise, and exchange.

    The same as ``crown_conv3d`` and batch normalisation in training mode between ``to_crown`` and ``from_crown``, in
    less time and memory. Both convolutions are computed as by ``conv3d_winograd``.

    Args:
        values: ``(B, in, N, V)``.
        first: from in to hidden channels.
        second: from hidden to out channels; it may be without normalisation.
        native: whether the forward pass uses operators in C++.

    Returns:
        ``(B, out, N, V)`` and the statistics of the normalisations, for running averages.

    References:
        Komatsu et al. (2020), CrownConv in three dimensions; Ioffe and Szegedy (2015), "Batch normalization", for
        the gradient.

    Examples:
        >>> layer = NormedLayer(torch.rand(2, 2, 21), torch.ones(2), torch.zeros(2), 1e-5)
        >>> result, _ = convolve_block(torch.rand(1, 2, 4, 42), layer, layer)
        >>> result.shape
        torch.Size([1, 2, 4, 42])
    """
    volumes = values.movedim(1, -1).contiguous()
    result, *statistics = _Block.apply(volumes, *first, *second, native)
    batch, count, vertices, _ = volumes.shape
    n = 2 ** level_from_num_vertices(vertices)
    places = batch * count * 10 * (2 * n + 1) * (n + 1)
    pairs = zip(statistics[::2], statistics[1::2], strict=True)
    return result.movedim(-1, 1), [Moments(mean, variance, places) for mean, variance in pairs]


def _plain_block(eps1: float, eps2: float) -> Callable[..., Tensor]:
    """The block in plain torch, for second derivatives: a function of volumes ``(B, N, V, in)`` and of parameters."""

    def normalized(
        crown: tuple[Tensor, ...], scale: Tensor | None, shift: Tensor | None, eps: float
    ) -> tuple[Tensor, ...]:
        if scale is None:
            return crown
        flat = torch.cat([rectangles.movedim(2, 0).flatten(1) for rectangles in crown], 1)
        flat = F.batch_norm(flat.T, None, None, scale, shift, True, eps=eps).T
        parts = flat.chunk(2, 1)
        return tuple(
            part.reshape(x.movedim(2, 0).shape).movedim(0, 2) for part, x in zip(parts, crown, strict=True)
        )

    def convolved(crown: tuple[Tensor, ...], weight: Tensor) -> tuple[Tensor, ...]:
        return tuple(convolve(x, weight, taps) for x, taps in zip(crown, TAPS, strict=True))

    def block(
        volumes: Tensor,
        weight1: Tensor,
        scale1: Tensor,
        shift1: Tensor,
        weight2: Tensor,
        scale2: Tensor | None,
        shift2: Tensor | None,
    ) -> Tensor:
        crown: tuple[Tensor, ...] = values_at_places(volumes.movedim(-1, 1))
        crown = normalized(convolved(crown, weight1), scale1, shift1, eps1)
        crown = normalized(convolved(tuple(x.relu() for x in crown), weight2), scale2, shift2, eps2)
        level = level_from_num_vertices(volumes.shape[2])
        return (sum_over_places(*crown) / plain_places_per_vertex(level, volumes)).movedim(1, -1)

    return block


class _Block(torch.autograd.Function):
    """Volumes ``(B, N, V, in)`` to volumes ``(B, N, V, out)``, and means and variances of both layers.

    In both passes a normalisation divides the work in two: its statistics, or sums of its gradient, are of all
    rectangles, so one round over the groups of rectangles must end before what comes after it can begin.
    """

    @staticmethod
    def forward(
        ctx: Any,
        volumes: Tensor,
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
        geometry, buffers = _Geometry(volumes), workspace()
        hidden, out = len(weight1), len(weight2)
        conv1, conv2 = geometry.outputs(hidden), geometry.outputs(out)
        native = native and cubes_pay(volumes, geometry.n)

        # First round: convolve, and count the statistics of the first normalisation.
        moments, kernels = _Moments(), _ready(weight1, native)
        padded = geometry.padded(volumes.shape[-1])
        for place, group, sample in geometry:
            given = geometry.take(sample, group, padded)
            result = geometry.view(conv1[place], group)
            _convolve(given, kernels[group.is_row], result, buffers)
            moments.add(result[:, : geometry.count])
        mean1, variance1 = moments.total()
        to_norm1 = _to_norm(mean1, (variance1 + eps1).rsqrt(), scale1, shift1)

        # Second round: normalise and rectify on the way into the second convolution; sum results by vertex.
        moments, kernels = _Moments(), _ready(weight2, native)
        padded = geometry.padded(hidden)
        sums = [PlaceSum(sample.new_empty(*sample.shape[:2], out), geometry.n) for sample in volumes]
        for place, group, _ in geometry:
            given = geometry.rectified(conv1[place], group, to_norm1, padded)
            result = geometry.view(conv2[place], group)
            _convolve(given, kernels[group.is_row], result, buffers)
            result = result[:, : geometry.count]
            sums[place // len(geometry.crown)].add(result, group)
            if scale2 is not None:
                moments.add(result)
        answer = _stack([total.mean() for total in sums])

        # The second normalisation is affine, as the mean over places is: it may follow on vertices, half as many.
        statistics = [mean1, variance1]
        kept = [volumes, conv1, weight1, scale1, shift1, weight2, mean1, variance1]
        if scale2 is not None and shift2 is not None:
            mean2, variance2 = moments.total()
            statistics += mean2, variance2
            kept += conv2, scale2, shift2, mean2, variance2
            factor, offset = _to_norm(mean2, (variance2 + eps2).rsqrt(), scale2, shift2)
            answer = torch.addcmul(offset, answer, factor)
        ctx.save_for_backward(*kept)
        ctx.eps = eps1, eps2
        ctx.mark_non_differentiable(*statistics)
        return answer, *statistics

    @staticmethod
    def backward(ctx: Any, gradient: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        volumes, conv1, weight1, scale1, shift1, weight2, mean1, variance1, *normed = ctx.saved_tensors
        if torch.is_grad_enabled():
            scale2, shift2 = normed[1:3] if normed else (None, None)
            inputs = (volumes, weight1, scale1, shift1, weight2, scale2, shift2)
            needed = [ctx.needs_input_grad[k] for k in (0, 1, 2, 3, 5, 6, 7)]
            found = reference_gradients(_plain_block(*ctx.eps), inputs, needed, gradient)
            return *found[:4], None, *found[4:], None, None
        invert1 = (variance1 + ctx.eps[0]).rsqrt()
        geometry, buffers = _Geometry(volumes, slack=True), workspace()
        # The adjoint of the mean over places: each place gets its share of the gradient of its vertex.
        by_vertex = gradient * places_per_vertex(geometry.n, gradient).reciprocal_()[:, None]

        # Second normalisation. Its gradient is, per channel, a * (gradient of the output) + b * (its input) + c, where
        # b and c stand for the dependence of mean and variance on the input; a and c can be applied on vertices.
        grad_scale2 = grad_shift2 = conv2 = by_input2 = None
        if normed:
            conv2, scale2, _, mean2, variance2 = normed
            invert2 = (variance2 + ctx.eps[1]).rsqrt()
            grad_shift2 = gradient.sum((0, 1, 2))
            grad_scale2 = torch.zeros_like(mean2)
            for place, group, sample in geometry.over(by_vertex):
                centered = geometry.view(conv2[place], group)[:, : geometry.count] - mean2
                grad_scale2 += centered.mul_(geometry.take_inner(sample, group)).sum((0, 1, 2, 3))
            grad_scale2 *= invert2
            by_input2, constant = geometry.norm_gradient(mean2, invert2, scale2, grad_scale2, grad_shift2)
            torch.addcmul(constant, by_vertex, scale2 * invert2, out=by_vertex)

        # Second convolution and ReLU: what the convolution was given is normalised and rectified once more from what
        # was kept, needed for the gradient of the weight and to tell where the ReLU was open.
        to_norm1 = _to_norm(mean1, invert1, scale1, shift1)
        kernels, grad_weight = _transformed(weight2, adjoint_kernels), _WeightGradient(weight2)
        padded, grad_padded = geometry.padded(len(weight1)), geometry.padded(len(weight1), slack=False)
        upstreams = geometry.outputs_with_zeros(len(weight2))
        grad_norm1 = torch.empty_like(conv1)
        grad_scale1, grad_shift1 = torch.zeros_like(mean1), torch.zeros_like(mean1)
        for place, group, sample in geometry.over(by_vertex):
            given = geometry.rectified(conv1[place], group, to_norm1, padded)
            upstream = geometry.zero_bordered(upstreams, group)
            inner = upstream[:, : geometry.count, 2:-2, 2:-2]
            inner.copy_(geometry.take_inner(sample, group))
            if conv2 is not None and by_input2 is not None:
                inner.addcmul_(geometry.view(conv2[place], group)[:, : geometry.count], by_input2)
            grad_given = geometry.without_slack(grad_padded, group).zero_()
            convolve_padded_backward(
                upstream,
                given,
                kernels[group.is_row],
                grad_given,
                grad_weight.sums[group.is_row],
                buffers,
                grad_weight.taps[group.is_row],
            )
            normed_gradient = geometry.view(grad_norm1[place], group)[:, : geometry.count]
            positive = given[:, 1 : geometry.count + 1, 1:-3, 1:-3] > 0
            torch.mul(unpadded(grad_given, geometry.count), positive, out=normed_gradient)
            # The two sums that the gradient of the first normalisation needs are counted on the way.
            grad_shift1 += normed_gradient.sum((0, 1, 2, 3))
            centered = geometry.view(conv1[place], group)[:, : geometry.count] - mean1
            grad_scale1 += centered.mul_(normed_gradient).sum((0, 1, 2, 3))
        grad_scale1 *= invert1
        grad_weight2 = grad_weight.total()

        # First normalisation, on the way into the first convolution, whose gradient is summed by vertex.
        by_input1, constant = geometry.norm_gradient(mean1, invert1, scale1, grad_scale1, grad_shift1)
        kernels, grad_weight = _transformed(weight1, adjoint_kernels), _WeightGradient(weight1)
        padded = geometry.padded(volumes.shape[-1])
        wanted = ctx.needs_input_grad[0]
        grad_padded = geometry.padded(volumes.shape[-1], slack=False) if wanted else padded
        upstreams = geometry.outputs_with_zeros(len(weight1))
        sums = [PlaceSum(torch.empty_like(sample), geometry.n) for sample in volumes] if wanted else []
        for place, group, sample in geometry:
            given = geometry.take(sample, group, padded)
            upstream = geometry.zero_bordered(upstreams, group)
            inner = upstream[:, : geometry.count, 2:-2, 2:-2]
            normed_gradient, output = (
                geometry.view(both[place], group)[:, : geometry.count] for both in (grad_norm1, conv1)
            )
            torch.addcmul(constant, normed_gradient, scale1 * invert1, out=inner)
            inner.addcmul_(output, by_input1)
            target = geometry.without_slack(grad_padded, group).zero_() if wanted else None
            convolve_padded_backward(
                upstream,
                given,
                kernels[group.is_row],
                target,
                grad_weight.sums[group.is_row],
                buffers,
                grad_weight.taps[group.is_row],
            )
            if target is not None:
                sums[place // len(geometry.crown)].add(unpadded(target, geometry.count), group)
        grad_volumes = _stack([total.total() for total in sums]) if wanted else None
        first = grad_weight.total(), grad_scale1, grad_shift1, None
        return grad_volumes, *first, grad_weight2, grad_scale2, grad_shift2, None, None


class _Geometry:
    """Where values of a batch ``(B, N, V, C)`` stand, and buffers of the right sizes.

    Iterating gives, for every group of rectangles of every sample, its number, its places and the sample ``(N, V, C)``.
    With ``slack``, rectangles are followed by two more rows and columns, so that padded values and gradients that are
    shifted against one another lie on grids of the same size; see ``add_gradient_of_rows``.
    """

    def __init__(self, volumes: Tensor, slack: bool = False) -> None:
        self.volumes, self.slack = volumes, slack
        _, self.count, vertices, _ = volumes.shape
        level = level_from_num_vertices(vertices)
        self.n = 2**level
        self.full = self.count + -self.count % 4
        self.crown = Rectangles(volumes[0], level, self.full, slack)
        self.groups = list(self.crown)

    def __iter__(self) -> Iterator[tuple[int, RectangleGroup, Tensor]]:
        return self.over(self.volumes)

    def over(self, values: Tensor) -> Iterator[tuple[int, RectangleGroup, Tensor]]:
        """Iterate with samples of other values ``(B, N, V, *)``."""
        for place, (sample, group) in enumerate(product(values, self.groups)):
            yield place, group, sample

    def outputs(self, channels: int) -> Tensor:
        """What a convolution puts out: ``(groups of all samples, places of a group, channels)``."""
        return self.volumes.new_empty(len(self.volumes) * len(self.crown), self.crown.size, channels)

    def view(self, outputs: Tensor, group: RectangleGroup) -> Tensor:
        """Outputs of one group as ``(g, N', h, w, C)``."""
        number, depth, height, width = group.places.shape
        border = 4 if self.slack else 2
        return outputs.view(number, depth - 2, height - border, width - border, -1)

    def padded(self, channels: int, slack: bool | None = None) -> Tensor:
        """A buffer for padded volumes of a group, all zero."""
        more = 2 if self.slack and slack is not False else 0
        size = self.crown.group_size * (self.full + 2) * (2 * self.n + 3 + more) * (self.n + 3 + more)
        return self.volumes.new_zeros(size, channels)

    def outputs_with_zeros(self, channels: int) -> Tensor:
        """A buffer for outputs of a group with two rows and columns of zeros all around."""
        size = self.crown.group_size * self.full * (2 * self.n + 5) * (self.n + 5)
        return self.volumes.new_zeros(2, size, channels)

    def zero_bordered(self, buffer: Tensor, group: RectangleGroup) -> Tensor:
        """Its part for one group, ``(g, N', h + 4, w + 4, C)``; each kind has its own, so that zeros stay."""
        number, depth, height, width = group.places.shape
        return buffer[int(group.is_row)].view(number, depth - 2, height, width, -1)

    def without_slack(self, buffer: Tensor, group: RectangleGroup) -> Tensor:
        """A buffer as padded volumes ``(g, N' + 2, h + 2, w + 2, C)``."""
        number, depth, height, width = group.places.shape
        return buffer.view(number, depth, height - 2, width - 2, -1)

    def take(self, sample: Tensor, group: RectangleGroup, buffer: Tensor) -> Tensor:
        """Padded volumes of one group."""
        torch.index_select(sample.view(-1, sample.shape[-1]), 0, group.places.flatten(), out=buffer)
        return buffer.view(*group.places.shape, -1)

    def take_inner(self, sample: Tensor, group: RectangleGroup) -> Tensor:
        """Values of one group without borders, ``(g, N, h, w, C)``."""
        end = -3 if self.slack else -1
        places = group.places[:, 1 : self.count + 1, 1:end, 1:end]
        taken = sample.view(-1, sample.shape[-1]).index_select(0, places.flatten())
        return taken.view(*places.shape, -1)

    def rectified(
        self, outputs: Tensor, group: RectangleGroup, to_norm: tuple[Tensor, Tensor], buffer: Tensor
    ) -> Tensor:
        """Outputs of one group normalised, rectified and padded."""
        padded = buffer.view(*group.places.shape, -1)
        with_border = padded[:, :, :-2, :-2] if self.slack else padded
        inner = with_border[:, 1 : self.count + 1, 1:-1, 1:-1]
        factor, offset = to_norm
        torch.addcmul(offset, self.view(outputs, group)[:, : self.count], factor, out=inner).relu_()
        repeat_border(with_border, self.count)
        return padded

    def norm_gradient(
        self, mean: Tensor, invert: Tensor, scale: Tensor, grad_scale: Tensor, grad_shift: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Factor of the input, and constant, in the gradient of a normalisation by ``scale * invert``, per channel.

        The gradient of the input x is ``scale * invert`` times that of the output, plus ``factor * x + constant``.
        """
        number = len(self.volumes) * self.count * 10 * (2 * self.n + 1) * (self.n + 1)
        by_input = -scale * invert.square() * grad_scale / number
        return by_input, -scale * invert * grad_shift / number - by_input * mean


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


class _WeightGradient:
    """The gradient of a weight ``(out, in, 21)``, gathered from both directions."""

    def __init__(self, weight: Tensor) -> None:
        self.weight = weight
        self.sums = [weight.new_zeros(6, 4, 3, *weight.shape[:2]) for _ in TAPS]
        self.taps = [neighbor_taps(taps) for taps in TAPS]

    def total(self) -> Tensor:
        grad_weight = self.weight.new_zeros(*self.weight.shape[:2], 3, 8)
        for taps, sums in zip(TAPS, self.sums, strict=True):
            grad_weight.index_add_(-1, torch.tensor(sum(taps, ()), device=sums.device), kernel_gradient(sums))
        return grad_weight[..., :7].flatten(-2)


Kernel = TypeVar("Kernel")


def _transformed(weight: Tensor, transform: Callable[..., Kernel]) -> list[Kernel]:
    """Kernels of both kinds of rectangles, made ready."""
    planar = [planar_kernel(weight.unflatten(-1, (3, 7)), taps) for taps in TAPS]
    return [transform(kernel, neighbor_taps(taps)) for kernel, taps in zip(planar, TAPS, strict=True)]


def _ready(weight: Tensor, native: bool) -> list[CubeKernel] | list[list[PlanarKernel]]:
    """Kernels of both kinds of rectangles for a forward pass."""
    if native and len(weight) >= MIN_CHANNELS:
        return _transformed(weight, cube_kernel)
    return _transformed(weight, transformed_kernels)


def _convolve(
    padded: Tensor, kernel: CubeKernel | list[PlanarKernel], result: Tensor, buffers: Workspace
) -> None:
    if isinstance(kernel, CubeKernel):
        convolve_cubes(padded, kernel, None, result, buffers, native=True)
    else:
        convolve_padded(padded, kernel, None, result, buffers)


def _stack(samples: list[Tensor]) -> Tensor:
    """One tensor of all; without a copy if there is only one."""
    return samples[0][None] if len(samples) == 1 else torch.stack(samples)


def _to_norm(mean: Tensor, invert: Tensor, scale: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
    """Factor and offset that normalise."""
    factor = invert * scale
    return factor, shift - mean * factor
