# SPDX-License-Identifier: Apache-2.0
"""Convolutions with a hexagon's seven taps by operators in C++, for any number of channels, in both passes.

``hex_convolution.cpp`` takes Winograd's algorithms along every dimension: F(3, 3) along rows and columns, of whose 25
products for nine results two are zero because two corners of the kernel are, and F(4, 3) along the hypotheses. A
result then takes 2.6 products in place of 9 of a planar convolution, or 3.8 in place of 27. Borders are repeated while
reading, not copied around, and nothing but results leaves the cache. In volumes of few channels transforms in the plane
cost more than they save: there ``hex_direct.cpp`` sums over the seven taps, 10.5 products a result.

The points of F(4, 3) are 0, +-1 / sqrt(2), +-sqrt(2) and infinity, as with the usual +-1 and +-2 in several dimensions
the largest errors would be several times as large; those of F(3, 3) are 0, 1, -1, 2 and infinity.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sphericalvision.crown.fast.double_backward import reference_gradients
from sphericalvision.crown.fast.native import native_operators
from sphericalvision.crown.taps import Taps, planar_kernel, repeat_border

__all__ = [
    "add_gradient_of_weight",
    "convolve_rectangles",
    "gradient_of_given",
    "hex_convolution",
    "hex_convolution_pays",
    "hex_factors",
    "hex_weight_gradient",
    "zero_factor_gradients",
]

LANES = 16
"""Results are summed in vectors of so many channels."""

DIRECT = 16
"""In volumes of no more channels than this the seven taps are summed directly."""

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
        convolutional neural networks", for F(4, 3); Barabasz et al. (2020), "Error analysis and improving the
        accuracy of Winograd convolution for deep neural networks", for the choice of points.
    """
    result: Tensor = _HexConvolution.apply(images, weight, bias, taps, border)
    return result


def hex_factors(
    weight: Float[Tensor, "O C taps"], taps: Taps, adjoint: bool = False
) -> Float[Tensor, "F S C_in C_out_filled"]:
    """Return a weight as factors of products, for ``convolve_rectangles`` or, ``adjoint``, ``gradient_of_given``.

    ``(1 or 6, 23 or 7, in, out)``, channels out filled up to a whole number of vectors.
    """
    transform = _to_factors(weight, taps)
    by_tap = weight.permute((2, 0, 1) if adjoint else (2, 1, 0))
    factors = (transform.flatten(0, 1) @ by_tap.flatten(1)).view(*transform.shape[:2], *by_tap.shape[1:])
    return F.pad(factors, (0, -factors.shape[-1] % native_operators().lanes())).contiguous()


def convolve_rectangles(
    given: Float[Tensor, "B N h_in w_in C"],
    factors: Float[Tensor, "F S C O_filled"],
    bias: Float[Tensor, " O"] | None,
    result: Float[Tensor, "B N h w O"],
    taps: Taps,
    rectify: bool = False,
    border: bool = False,
) -> None:
    """Convolve volumes, or images of one hypothesis, into ``result``; channels lie together in both."""
    if _is_direct(factors):
        native_operators().hex_direct(given, factors, _places(taps), bias, border, result)
        if rectify:
            result.relu_()
        return
    native_operators().hex_convolve(given, factors, bias, rectify, border, result)


def gradient_of_given(
    grad_result: Float[Tensor, "B N h w O"],
    factors: Float[Tensor, "F S O C_filled"],
    grad_given: Float[Tensor, "B N h_in w_in C"],
    taps: Taps,
    border: bool = False,
) -> None:
    """The adjoint of ``convolve_rectangles``, added to ``grad_given``; ``factors`` are ``adjoint``."""
    if _is_direct(factors):  # with the taps on the other side of the centre
        places = 8 - _places(taps)
        native_operators().hex_direct_backward_given(grad_result, factors, places, border, grad_given)
        return
    native_operators().hex_convolve_backward_given(grad_result, factors, border, grad_given)


def zero_factor_gradients(
    weight: Float[Tensor, "O C taps"], taps: Taps
) -> Float[Tensor, "threads F S C O_filled"]:
    """Return zeros for ``add_gradient_of_weight``: a part for every thread, added up in the end in the same order."""
    planes, slots, _ = _to_factors(weight, taps).shape
    out, channels, _ = weight.shape
    return weight.new_zeros(torch.get_num_threads(), planes, slots, channels, out + -out % native_operators().lanes())


def add_gradient_of_weight(
    given: Float[Tensor, "B N h_in w_in C"],
    grad_result: Float[Tensor, "B N h w O"],
    parts: Float[Tensor, "threads F S C O_filled"],
    taps: Taps,
    border: bool = False,
) -> None:
    """The adjoint of ``convolve_rectangles`` with respect to its factors, added to ``parts``."""
    if _is_direct(parts):
        native_operators().hex_direct_backward_weight(given, grad_result, _places(taps), border, parts)
        return
    native_operators().hex_convolve_backward_weight(given, grad_result, border, parts)


def hex_weight_gradient(
    parts: Float[Tensor, "threads F S C O_filled"], weight: Float[Tensor, "O C taps"], taps: Taps
) -> Float[Tensor, "O C taps"]:
    """The gradient of a weight from that of its factors: the adjoint of ``hex_factors``."""
    transform = _to_factors(weight, taps).flatten(0, 1)
    by_factor = parts.sum(0)[..., : len(weight)].flatten(0, 1)
    return (transform.T @ by_factor.flatten(1)).view(-1, *by_factor.shape[1:]).permute(2, 1, 0)


def _to_factors(weight: Tensor, taps: Taps) -> Tensor:
    """From taps to factors by the way that is faster for a weight, ``(planes, slots, taps)``, in its precision."""
    depth = weight.shape[-1] // 7
    direct = depth > 1 and max(weight.shape[:2]) <= DIRECT
    return _transform(taps, depth, direct).to(weight.dtype)


def _is_direct(factors: Tensor) -> bool:
    return factors.shape[-3] == 7


@lru_cache(maxsize=2)
@torch.inference_mode(False)  # kept for training, too
def _places(taps: Taps) -> Tensor:
    """Which of nine places each tap is, ``(7,)``."""
    flat = sum(taps, ())
    return torch.tensor([flat.index(tap) for tap in range(7)], device="cpu")


@lru_cache(maxsize=8)
@torch.inference_mode(False)  # kept for training, too
def _transform(taps: Taps, depth: int, direct: bool) -> Tensor:
    """From taps to factors, ``(planes, slots, taps)``, float64 on the CPU; without two slots that are always zero."""

    def table(rows: tuple[tuple[float, ...], ...]) -> Tensor:
        return torch.tensor(rows, dtype=torch.float64, device="cpu")

    line, plane = table(_LINE_TAPS if depth > 1 else ((1.0,),)), table(_PLANE_TAPS)
    # Every tap by itself as a planar kernel (7, 3, 3), of which the first and the last place are none.
    single = planar_kernel(torch.eye(7, dtype=torch.float64, device="cpu"), taps)
    slots = torch.einsum("ri,sj,tij->rst", plane, plane, single).flatten(0, 1)[1:-1]
    if direct:
        slots = torch.eye(7, dtype=torch.float64, device="cpu")
    return torch.einsum("kd,st->ksdt", line, slots).flatten(2)


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
        convolve_rectangles(given, hex_factors(weight, taps), bias, result, taps, border=border)
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
        given, upstream = _volumes(images), _volumes(gradient)
        grad_images = grad_weight = None
        if wanted[0]:
            grad_given = given.new_zeros(given.shape)
            gradient_of_given(upstream, hex_factors(weight, taps, adjoint=True), grad_given, taps, border)
            grad_images = _images(grad_given, images)
        if wanted[1]:
            parts = zero_factor_gradients(weight, taps)
            add_gradient_of_weight(given, upstream, parts, taps, border)
            grad_weight = hex_weight_gradient(parts, weight, taps)
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
