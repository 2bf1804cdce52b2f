# SPDX-License-Identifier: Apache-2.0
"""The one door to the operators in C++: layers ask here, and are computed plainly where operators do not fit.

Operators compute on a CPU, in the precision of the weights, at stride 1; under ``core.kernels("auto")`` in single
precision once they are compiled, under ``"require"`` wherever they can.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.modules.batchnorm import _BatchNorm

from sphericalvision.core import way_of_kernels
from sphericalvision.crown.fast.build import operators_ready
from sphericalvision.crown.fast.convolution import hex_convolution
from sphericalvision.crown.fast.normalization import crown_normalization
from sphericalvision.crown.taps import ROW_TAPS, Taps, convolve

__all__ = ["convolve_rectangles", "normalize", "settled_way"]

Pair = tuple[Tensor, Tensor]


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
    way = way_of_kernels()
    # In double precision a vector takes two registers; operators serve there to be compared with the reference.
    return (values.dtype == torch.float32 or way == "require") and operators_ready(way)


def convolve_rectangles(
    rectangles: Float[Tensor, "B 5 C *N h_in w_in"],
    weight: Float[Tensor, "O C taps"],
    taps: Taps,
    bias: Float[Tensor, " O"] | None = None,
    stride: int = 1,
    border: bool = False,
    relu: bool = False,
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
    """
    images = rectangles.flatten(0, 1)
    if stride == 1 and _operators_fit(images, weight):
        result = hex_convolution(images, weight, bias, taps == ROW_TAPS, border, relu)
    else:
        result = convolve(images, weight, taps, bias, stride, border)
        if relu:
            result = result.relu() if torch.is_grad_enabled() else result.relu_()
    return result.unflatten(0, (-1, 5))


def normalize(
    col: Float[Tensor, "B 5 C *N h w"],
    row: Float[Tensor, "B 5 C *N w h"],
    norm: _BatchNorm,
    per_sample: bool,
    relu: bool,
) -> Pair | None:
    """Normalise rectangles by their own statistics, which running averages take in; None where operators do not fit."""
    if norm.weight is None or not _operators_fit(col, norm.weight):
        return None
    first, second, mean, variance = crown_normalization(
        col, row, norm.weight, norm.bias, norm.eps, per_sample, relu
    )
    if norm.training and norm.running_mean is not None:
        _track(norm, mean[0], variance[0], 2 * col.numel() // col.shape[2])
    return first, second


def settled_way() -> str:
    """The way of ``core.kernels`` in force here and now; layers that have another way in torch ask, too.

    Who computes the same once more needs it, as ``"auto"`` may change between two times, once operators are compiled.
    """
    way = way_of_kernels()
    return way if way != "auto" or operators_ready(way) else "plain"


@torch.no_grad()
def _track(norm: _BatchNorm, mean: Tensor, variance: Tensor, places: int) -> None:
    """Let running statistics take a step towards those of a batch, as ``forward`` does in training mode."""
    assert norm.running_mean is not None
    assert norm.running_var is not None
    assert norm.num_batches_tracked is not None
    norm.num_batches_tracked.add_(1)
    rate = 1 / float(norm.num_batches_tracked) if norm.momentum is None else norm.momentum
    norm.running_mean.lerp_(mean, rate)
    norm.running_var.lerp_(variance * (places / (places - 1)), rate)
