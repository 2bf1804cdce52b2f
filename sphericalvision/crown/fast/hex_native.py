# SPDX-License-Identifier: Apache-2.0
"""Convolutions with a hexagon's seven taps by operators in C++, for any number of channels, in both passes.

Libraries for planar convolutions multiply with the two zeros of a 3 x 3 kernel, too, and reach two thirds of a
processor's speed where there are few channels. ``hex_convolution.cpp`` sums over seven taps, and in volumes takes
Winograd's F(4, 3) along the hypotheses: six products in place of twelve, so that 7/18 of the multiplications are left.
Borders are repeated while reading, not copied around.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sphericalvision.crown.fast.double_backward import reference_gradients
from sphericalvision.crown.fast.native import native_operators
from sphericalvision.crown.fast.winograd_cubes import LINE_TAPS
from sphericalvision.crown.taps import Taps, planar_kernel, repeat_border

__all__ = ["hex_convolution", "hex_convolution_pays"]

LANES = 16
"""Results are summed in vectors of so many channels."""


def hex_convolution_pays(
    images: Float[Tensor, " ..."], weight: Float[Tensor, "O C taps"], stride: int
) -> bool:
    """Whether the operators can convolve these: on a CPU, in single or double precision, at stride 1."""
    return (
        stride == 1
        and images.device.type == weight.device.type == "cpu"
        and images.dtype == weight.dtype
        and images.dtype in (torch.float32, torch.float64)
        and images.numel() > 0
        and not torch.is_autocast_enabled("cpu")
    )


def hex_convolution(
    images: Float[Tensor, "B C *N h_in w_in"],
    weight: Float[Tensor, "O C taps"],
    bias: Float[Tensor, " O"] | None,
    taps: Taps,
    border: bool = False,
) -> Float[Tensor, "B O *N h w"]:
    """Convolve rectangles or charts of one kind, differentiable twice.

    Args:
        images: ``(B, C, h, w)``, or volumes ``(B, C, N, h, w)``, whose first and last hypothesis is repeated.
        weight: ``(O, C, 7)``, or ``(O, C, 21)`` for volumes, index ``7 * depth + tap``.
        bias: ``(O,)``.
        taps: which of nine places each tap is.
        border: whether the images have a border of one more place all around; otherwise theirs is repeated.

    Returns:
        ``(B, O, [N,] h, w)``, channels next to each other in memory.

    References:
        Winograd (1980), "Arithmetic complexity of computations"; Lavin and Gray (2016), "Fast algorithms for
        convolutional neural networks", for F(4, 3).
    """
    result: Tensor = _HexConvolution.apply(images, weight, bias, taps, border)
    return result


def _plain(taps: Taps, border: bool, images: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    """The same in plain torch."""
    if not border:
        images = repeat_border(images)
    elif images.ndim == 5:
        images = torch.cat((images[:, :, :1], images, images[:, :, -1:]), 2)
    if images.ndim == 4:
        return F.conv2d(images, planar_kernel(weight, taps), bias)
    return F.conv3d(images, planar_kernel(weight.unflatten(-1, (3, 7)), taps), bias)


class _HexConvolution(torch.autograd.Function):
    """Images, weight and bias to convolved images."""

    @staticmethod
    def forward(
        ctx: Any, images: Tensor, weight: Tensor, bias: Tensor | None, taps: Taps, border: bool
    ) -> Tensor:
        given = _volumes(images)
        batch, depth, height, width, _ = given.shape
        size = (batch, depth, height - 2 * border, width - 2 * border, len(weight))
        result = given.new_empty(size)
        ready = _filled(_factors(weight).transpose(2, 3))
        native_operators().hex_convolve(given, ready, _places(taps), bias, border, result)
        ctx.save_for_backward(images, weight, bias)
        ctx.options = taps, border
        return _images(result, images)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        images, weight, bias = ctx.saved_tensors
        taps, border = ctx.options
        wanted = ctx.needs_input_grad
        if torch.is_grad_enabled():

            def plain(images: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
                return _plain(taps, border, images, weight, bias)

            return *reference_gradients(plain, (images, weight, bias), wanted[:3], gradient), None, None
        operators, places = native_operators(), _places(taps)
        given, upstream = _volumes(images), _volumes(gradient)
        grad_images = grad_weight = None
        if wanted[0]:
            # The adjoint has the taps on the other side of the centre, and channels in and out change places.
            grad_given = given.new_zeros(given.shape)
            ready = _filled(_factors(weight))
            operators.hex_convolve_backward_given(upstream, ready, 8 - places, border, grad_given)
            grad_images = _images(grad_given, images)
        if wanted[1]:
            factors = 1 if images.ndim == 4 else len(LINE_TAPS)
            filled = len(weight) + -len(weight) % LANES
            parts = given.new_zeros(torch.get_num_threads(), factors, 7, given.shape[-1], filled)
            operators.hex_convolve_backward_weight(given, upstream, places, border, parts)
            grad_factors = parts.sum(0)[..., : len(weight)]
            if images.ndim == 4:
                grad_weight = grad_factors[0].permute(2, 1, 0)
            else:
                transform = given.new_tensor(LINE_TAPS)
                grad_weight = torch.einsum("kd,ktco->ocdt", transform, grad_factors).flatten(2)
        grad_bias = upstream.sum((0, 1, 2, 3)) if wanted[2] else None
        return grad_images, grad_weight, grad_bias, None, None


def _volumes(images: Tensor) -> Tensor:
    """View ``(B, C, [N,] h, w)`` as ``(B, N, h, w, C)``, channels next to each other in memory."""
    volumes = (images.unsqueeze(2) if images.ndim == 4 else images).movedim(1, -1)
    return volumes if volumes.stride(-1) == 1 else volumes.contiguous()


def _images(volumes: Tensor, like: Tensor) -> Tensor:
    """Undo ``_volumes``."""
    images = volumes.movedim(-1, 1)
    return images.squeeze(2) if like.ndim == 4 else images


def _factors(weight: Tensor) -> Tensor:
    """A weight as factors of products, ``(1 or 6, 7, O, C)``."""
    if weight.shape[-1] == 7:
        return weight.permute(2, 0, 1)[None]
    return torch.einsum("kd,ocdt->ktoc", weight.new_tensor(LINE_TAPS), weight.unflatten(-1, (3, 7)))


def _filled(factors: Tensor) -> Tensor:
    """With zeros up to a whole number of vectors."""
    return F.pad(factors, (0, -factors.shape[-1] % LANES)).contiguous()


@lru_cache(maxsize=2)
@torch.inference_mode(False)  # kept for training, too
def _places(taps: Taps) -> Tensor:
    """Which of nine places each tap is, ``(7,)``."""
    flat = sum(taps, ())
    return torch.tensor([flat.index(tap) for tap in range(7)], device="cpu")
