# SPDX-License-Identifier: Apache-2.0
"""Where crowns choose how they are computed, and the one door to the operators in C++.

Layers ask here, and are computed by torch where operators do not fit. Operators compute on a CPU, in the precision of
the weights, at stride 1; under ``kernels("auto")`` in single precision once they are compiled, under ``"require"``
wherever they can.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float, Int32, Shaped
from torch import Tensor
from torch.nn.modules.batchnorm import _BatchNorm
from torch.utils.checkpoint import checkpoint

from sphericalvision.crown.fast.build import operators_ready
from sphericalvision.crown.fast.convolution import hex_convolution, vertices_at_places
from sphericalvision.crown.fast.normalization import crown_normalization
from sphericalvision.crown.taps import ROW_TAPS, Taps, convolve
from sphericalvision.icosphere import level_from_num_vertices
from sphericalvision.kernels import kernel_mode, prefer_fused, uses_reference_kernels

__all__ = [
    "convolve_charts",
    "convolve_rectangles",
    "convolve_vertices",
    "normalize",
    "operators_in_use",
    "recomputation_pays",
    "slices_pay",
]


Pair = tuple[Tensor, Tensor]


def operators_in_use() -> bool:
    """Whether ``kernels`` asks for operators in C++ here and now, and they are compiled."""
    return operators_ready(kernel_mode())


def recomputation_pays(values: Float[Tensor, " ..."]) -> bool:
    """Whether training computes twice what takes memory and little time: where operators are, and torch allows it."""
    # The transforms of torch.func know no hooks of saved tensors.
    transformed = torch._C._are_functorch_transforms_active()
    compiling = torch.compiler.is_compiling()
    return values.device.type == "cpu" and operators_in_use() and not transformed and not compiling


def slices_pay(values: Shaped[Tensor, " ..."]) -> bool:
    """Whether crowns are made by slices, on a CPU; the reference looks every vertex up, and so do graphs."""
    # Slices are a function of autograd of our own, which the transforms of torch.func do not know.
    transformed = torch._C._are_functorch_transforms_active()
    in_torch = uses_reference_kernels() or prefer_fused(values.device)
    return values.device.type == "cpu" and not in_torch and not transformed


def _operators_fit(values: Float[Tensor, " ..."], weight: Float[Tensor, " ..."]) -> bool:
    """Whether operators in C++ compute what is made of values and a weight."""
    if values.device.type != "cpu" or weight.device.type != "cpu" or values.dtype != weight.dtype:
        return False
    if values.dtype not in (torch.float32, torch.float64) or not values.numel():
        return False
    # The transforms of torch.func take functions apart that torch knows; autocast asks for another precision.
    if torch._C._are_functorch_transforms_active() or torch.is_autocast_enabled("cpu"):
        return False
    if torch.compiler.is_exporting():  # programs that leave this package know the operators of torch alone
        return False
    # In double precision a vector takes two registers; operators serve there to be compared with the reference.
    return (values.dtype == torch.float32 or kernel_mode() == "require") and operators_in_use()


def convolve_rectangles(
    rectangles: Float[Tensor, "B 5 C *N h_in w_in"],
    weight: Float[Tensor, "O C taps"],
    taps: Taps,
    bias: Float[Tensor, " O"] | None = None,
    stride: int = 1,
    border: bool = False,
    relu: bool = False,
    kernel: Float[Tensor, "O C *depth 3 3"] | None = None,
) -> Float[Tensor, "B 5 O *N h w"]:
    """Convolve rectangles, or charts that have a ``border``, of one kind; arguments as for ``taps.convolve``.

    Args:
        rectangles: ``(B, 5, in, [N,] h, w)``.
        weight: ``(out, in, 7)`` or ``(out, in, 21)``.
        taps: ``COL_TAPS`` or ``ROW_TAPS``.
        bias: ``(out,)``.
        stride: 1 or 2.
        border: whether there is one more place all around.
        relu: whether results are rectified.
        kernel: the weight as a planar kernel, where that is made already.
    """
    # Operators rectify where nobody differentiates: a derivative would have to keep their results.
    keeps = torch.is_grad_enabled()
    if stride == 1 and _operators_fit(rectangles, weight):
        volumes, rectify = _inward(rectangles).flatten(0, 1), relu and not keeps
        result = hex_convolution(volumes, weight, bias, taps == ROW_TAPS, border, rectify, None)
        result = _outward(result.unflatten(0, (-1, 5)), rectangles.ndim)
        return result.relu() if relu and keeps else result
    images = rectangles.flatten(0, 1)
    if keeps and images.requires_grad and recomputation_pays(images):
        # A border that is copied around is not kept: who reads that which is copied keeps it anyway.
        result = checkpoint(convolve, images, weight, taps, bias, stride, border, kernel, use_reentrant=False)
    else:
        result = convolve(images, weight, taps, bias, stride, border, kernel)
    if relu:
        result = result.relu() if keeps else result.relu_()
    return result.unflatten(0, (-1, 5))


def _inward(rectangles: Tensor) -> Tensor:
    """View rectangles ``(B, 5, C, [N,] h, w)`` as operators take them, ``(B, 5, N, h, w, C)``."""
    return (rectangles.unsqueeze(3) if rectangles.ndim == 5 else rectangles).movedim(2, -1)


def _outward(result: Tensor, ndim: int) -> Tensor:
    """Undo ``_inward``."""
    rectangles = result.movedim(-1, 2)
    return rectangles.squeeze(3) if ndim == 5 else rectangles


def convolve_vertices(
    values: Float[Tensor, "B C *N V"],
    weight: Float[Tensor, "O C taps"],
    bias: Float[Tensor, " O"] | None,
    relu: bool,
) -> Pair | None:
    """Convolve the crown of values at stride 1 without making it; None where operators do not fit."""
    if (
        (relu and torch.is_grad_enabled())
        or not _operators_fit(values, weight)
        or torch.compiler.is_compiling()
    ):
        return None
    col, row = (
        _convolve_at(places, values, weight, bias, bool(across), False, relu)
        for across, places in enumerate(vertices_at_places(level_from_num_vertices(values.shape[-1])))
    )
    return col, row


def convolve_charts(
    values: Float[Tensor, "B C *N V"],
    weight: Float[Tensor, "O C taps"],
    bias: Float[Tensor, " O"] | None,
    places: Callable[[int], Int32[Tensor, "5 h w"]],
) -> Float[Tensor, "B 5 O *N rows columns"] | None:
    """Convolve the charts of values at stride 1 without making them; None where operators do not fit.

    Args:
        values: ``(B, in, [N,] V)``.
        weight: ``(out, in, 7)`` or ``(out, in, 21)``.
        bias: ``(out,)``.
        places: of a level, which vertices are in charts and their border.
    """
    if not _operators_fit(values, weight) or torch.compiler.is_compiling():
        return None
    table = places(level_from_num_vertices(values.shape[-1]))
    return _convolve_at(table, values, weight, bias, False, True, False)


def _convolve_at(
    places: Tensor,
    values: Tensor,
    weight: Tensor,
    bias: Tensor | None,
    across: bool,
    border: bool,
    relu: bool,
) -> Tensor:
    """Convolve what five tables of vertices lay out, as ``(B, 5, O, [N,] h, w)``."""
    volumes = (values.unsqueeze(2) if values.ndim == 3 else values).movedim(1, -1)
    result = hex_convolution(volumes, weight, bias, across, border, relu, places)
    return _outward(result.unflatten(0, (-1, 5)), values.ndim + 2)


def normalize(
    col: Float[Tensor, "B 5 C *N h w"],
    row: Float[Tensor, "B 5 C *N w h"],
    norm: _BatchNorm,
    per_sample: bool,
    relu: bool,
    convolution: tuple[Tensor, Tensor | None] | None = None,
) -> Pair | None:
    """Normalise rectangles by their own statistics, which running averages take in; None where operators do not fit.

    Args:
        col: ``(B, 5, C, [N,] h, w)``.
        row: ``(B, 5, C, [N,] w, h)``.
        norm: the layer, whose weights and running averages are used.
        per_sample: whether each sample has statistics of its own.
        relu: whether results are rectified.
        convolution: weight and bias of one that follows the ReLU, at stride 1: what it is given is never written.
    """
    weight, bias = convolution or (None, None)
    if norm.weight is None or not _operators_fit(col, norm.weight):
        return None
    if weight is not None and not _operators_fit(col, weight):
        return None
    first, second, mean, variance = crown_normalization(
        _inward(col), _inward(row), norm.weight, norm.bias, weight, bias, norm.eps, per_sample, relu
    )
    _track(norm, mean, variance, col)
    return _outward(first, col.ndim), _outward(second, col.ndim)


@torch.no_grad()
def _track(norm: _BatchNorm, mean: Tensor, variance: Tensor, col: Tensor) -> None:
    """Let running statistics take a step towards those of a batch, as ``forward`` does in training mode."""
    if not norm.training or norm.running_mean is None:
        return
    assert norm.running_var is not None
    assert norm.num_batches_tracked is not None
    norm.num_batches_tracked.add_(1)
    rate = 1 / float(norm.num_batches_tracked) if norm.momentum is None else norm.momentum
    places = 2 * col.numel() // col.shape[2]
    # Through ``data``, as torch's own layers do it: the formulas of a batch keep the running statistics without using
    # them, and would take them for changed where a layer serves camera after camera and operators come in between.
    norm.running_mean.data.lerp_(mean[0], rate)
    norm.running_var.data.lerp_(variance[0] * (places / (places - 1)), rate)
