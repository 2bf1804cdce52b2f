# SPDX-License-Identifier: Apache-2.0
"""Two normalised 3D crown convolutions for training, a few rectangles at a time in both passes.

In plain layers the backward pass would keep, for every layer, crowns of all places with their borders. Here it keeps
the volumes given and what the two convolutions put out before normalisation, and nothing else: normalised values, ReLU,
copies with borders and Winograd's transforms are made again where they are wanted, a group of rectangles at a time, in
cache. That is less memory and, as memory is what these steps wait for, less time too.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sphericalvision.crown.fast.block_parts import (
    BlockPlaces,
    MomentSums,
    NativeConvolution,
    TorchConvolution,
    norm_factors,
    stack_samples,
)
from sphericalvision.crown.fast.double_backward import reference_gradients
from sphericalvision.crown.fast.hex_native import hex_convolution_pays
from sphericalvision.crown.fast.layout import places_per_vertex
from sphericalvision.crown.fast.rectangles import PlaceSum
from sphericalvision.crown.places import places_per_vertex as plain_places_per_vertex
from sphericalvision.crown.places import sum_over_places, values_at_places
from sphericalvision.crown.taps import COL_TAPS, ROW_TAPS, convolve
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
        native: whether to use operators in C++ where they can.

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
        native = native and hex_convolution_pays(volumes, weight1, stride=1)
        convolution = NativeConvolution if native else TorchConvolution
        geometry = BlockPlaces(volumes, native)
        hidden, out = len(weight1), len(weight2)
        conv1, conv2 = geometry.outputs(hidden), geometry.outputs(out)

        # First round: convolve, and count the statistics of the first normalisation.
        moments, convolve_first = MomentSums(), convolution(weight1, geometry)
        for place, group, sample in geometry:
            result = geometry.view(conv1[place], group)
            convolve_first(convolve_first.take(sample, group), group, result)
            moments.add(result[:, : geometry.count])
        mean1, variance1 = moments.total()
        to_norm1 = norm_factors(mean1, (variance1 + eps1).rsqrt(), scale1, shift1)

        # Second round: normalise and rectify on the way into the second convolution; sum results by vertex.
        moments, convolve_second = MomentSums(), convolution(weight2, geometry)
        sums = [PlaceSum(sample.new_empty(*sample.shape[:2], out), geometry.n) for sample in volumes]
        for place, group, _ in geometry:
            result = geometry.view(conv2[place], group)
            convolve_second(convolve_second.rectified(conv1[place], group, to_norm1), group, result)
            result = result[:, : geometry.count]
            sums[place // len(geometry.crown)].add(result, group)
            if scale2 is not None:
                moments.add(result)
        answer = stack_samples([total.mean() for total in sums])

        # The second normalisation is affine, as the mean over places is: it may follow on vertices, half as many.
        statistics = [mean1, variance1]
        kept = [volumes, conv1, weight1, scale1, shift1, weight2, mean1, variance1]
        if scale2 is not None and shift2 is not None:
            mean2, variance2 = moments.total()
            statistics += mean2, variance2
            kept += conv2, scale2, shift2, mean2, variance2
            factor, offset = norm_factors(mean2, (variance2 + eps2).rsqrt(), scale2, shift2)
            answer = torch.addcmul(offset, answer, factor)
        ctx.save_for_backward(*kept)
        ctx.eps, ctx.native = (eps1, eps2), native
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
        geometry = BlockPlaces(volumes, ctx.native, backward=True)
        convolution = NativeConvolution if ctx.native else TorchConvolution
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
        to_norm1 = norm_factors(mean1, invert1, scale1, shift1)
        second = convolution(weight2, geometry, backward=True)
        grad_norm1 = torch.empty_like(conv1)
        grad_scale1, grad_shift1 = torch.zeros_like(mean1), torch.zeros_like(mean1)
        for place, group, sample in geometry.over(by_vertex):
            given = second.rectified(conv1[place], group, to_norm1)
            upstream = second.upstream(group).copy_(geometry.take_inner(sample, group))
            if conv2 is not None and by_input2 is not None:
                upstream.addcmul_(geometry.view(conv2[place], group)[:, : geometry.count], by_input2)
            normed_gradient = geometry.view(grad_norm1[place], group)[:, : geometry.count]
            grad_given = second.gradients(given, group)
            assert grad_given is not None
            torch.mul(grad_given, second.inner(given) > 0, out=normed_gradient)
            # The two sums that the gradient of the first normalisation needs are counted on the way.
            grad_shift1 += normed_gradient.sum((0, 1, 2, 3))
            centered = geometry.view(conv1[place], group)[:, : geometry.count] - mean1
            grad_scale1 += centered.mul_(normed_gradient).sum((0, 1, 2, 3))
        grad_scale1 *= invert1
        grad_weight2 = second.weight_gradient()

        # First normalisation, on the way into the first convolution, whose gradient is summed by vertex.
        by_input1, constant = geometry.norm_gradient(mean1, invert1, scale1, grad_scale1, grad_shift1)
        first = convolution(weight1, geometry, backward=True)
        wanted = ctx.needs_input_grad[0]
        sums = [PlaceSum(torch.empty_like(sample), geometry.n) for sample in volumes] if wanted else []
        for place, group, sample in geometry:
            normed_gradient, output = (
                geometry.view(both[place], group)[:, : geometry.count] for both in (grad_norm1, conv1)
            )
            upstream = first.upstream(group)
            torch.addcmul(constant, normed_gradient, scale1 * invert1, out=upstream)
            upstream.addcmul_(output, by_input1)
            grad_given = first.gradients(first.take(sample, group), group, wanted)
            if grad_given is not None:
                sums[place // len(geometry.crown)].add(grad_given, group)
        grad_volumes = stack_samples([total.total() for total in sums]) if wanted else None
        return (
            grad_volumes,
            *(first.weight_gradient(), grad_scale1, grad_shift1, None),
            *(grad_weight2, grad_scale2, grad_shift2, None),
            None,
        )
