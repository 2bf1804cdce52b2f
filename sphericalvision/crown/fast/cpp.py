# SPDX-License-Identifier: Apache-2.0
"""Bodies by operators in C++, which compute on a CPU, in the precision of the weights, at stride 1.

Under ``kernels("auto")`` they are in use in single precision once they are compiled, under ``"require"`` wherever they
can be.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from sphericalvision.crown import hexagons, taps
from sphericalvision.crown.charts import chart_vertices
from sphericalvision.crown.fast.build import operators_ready
from sphericalvision.crown.fast.convolution import hex_convolution, vertices_at_places
from sphericalvision.crown.fast.normalization import crown_normalization
from sphericalvision.crown.statistics import CrownNorm, Pair
from sphericalvision.icosphere import level_from_num_vertices
from sphericalvision.kernels import is_traced, kernel_mode
from sphericalvision.tables import constant_table


def operators_in_use() -> bool:
    """Whether the mode of ``kernels`` asks for operators in C++, and they are compiled."""
    # A library cannot be loaded while a function is traced.
    return operators_ready(kernel_mode(), may_load=not torch.compiler.is_compiling())


def mode_in_use() -> str:
    """The mode of ``kernels`` that computes as this moment does: operators may be compiled in the next one."""
    mode = kernel_mode()
    return "plain" if mode == "auto" and not operators_in_use() else mode


def recomputation_pays(values: Float[Tensor, " ..."]) -> bool:
    """Whether training computes twice what takes memory and little time: where operators are, and torch allows it."""
    # The transforms of torch.func know no hooks of saved tensors.
    return values.device.type == "cpu" and operators_in_use() and not is_traced()


def _operators_fit(values: Tensor, weight: Tensor) -> bool:
    """Whether operators in C++ compute what is made of values and a weight."""
    if weight.device.type != "cpu" or values.dtype != weight.dtype or not values.numel():
        return False
    if values.dtype not in (torch.float32, torch.float64) or torch.is_autocast_enabled("cpu"):
        return False
    # In double precision a vector takes two registers; operators serve there to be compared with the reference.
    return (values.dtype == torch.float32 or kernel_mode() == "require") and operators_in_use()


def convolve_rectangles(
    col: Tensor, row: Tensor, weight: Tensor, bias: Tensor | None = None, stride: int = 1, relu: bool = False
) -> Pair:
    """Convolve rectangles as ``taps.convolve_rectangles`` does; at stride 2 by torch, keeping no copied borders."""
    differentiates = torch.is_grad_enabled()
    if stride == 1 and _operators_fit(col, weight):
        # Operators rectify only without derivatives, which would have to keep their results.
        pair = tuple(
            _outward(
                hex_convolution(
                    _inward(x).flatten(0, 1), weight, bias, is_row, False, relu and not differentiates, None
                ).unflatten(0, (-1, 5)),
                x.ndim,
            )
            for is_row, x in zip((False, True), (col, row), strict=True)
        )
    elif differentiates and col.requires_grad and recomputation_pays(col):
        pair = tuple(
            _without_keeping_borders(x.flatten(0, 1), kernel, bias, stride).unflatten(0, (-1, 5))
            for x, kernel in zip((col, row), taps.planar_kernels(weight), strict=True)
        )
    else:
        return NotImplemented
    first, second = (x.relu() for x in pair) if relu and differentiates else pair
    return first, second


def _without_keeping_borders(images: Tensor, kernel: Tensor, bias: Tensor | None, stride: int) -> Tensor:
    """Convolve images; what is copied around them is copied again for the derivative.

    The convolution alone in a checkpoint ends the second computation before it convolves.
    """

    def run(images: Tensor, kernel: Tensor) -> Tensor:
        return taps.convolve(taps.repeat_border(images), kernel, bias, stride)

    result: Tensor = checkpoint(run, images, kernel, use_reentrant=False)
    return result


def convolve_vertices(
    values: Tensor, weight: Tensor, bias: Tensor | None = None, stride: int = 1, relu: bool = False
) -> Pair:
    """Convolve the crown of values without making it."""
    if stride != 1 or (relu and torch.is_grad_enabled()) or not _operators_fit(values, weight):
        return NotImplemented
    col, row = (
        _convolve_at(vertex_ids, values, weight, bias, is_row, False, relu)
        for is_row, vertex_ids in zip(
            (False, True), vertices_at_places(level_from_num_vertices(values.shape[-1])), strict=True
        )
    )
    return col, row


def convolve_hexagons(
    values: Tensor, weight: Tensor, bias: Tensor | None, stride: int, *others: Any
) -> Tensor:
    """Convolve values or volumes as ``hexagons.hexagons`` does, without making charts."""
    if stride != 1 or not _operators_fit(values, weight):
        return NotImplemented
    return hexagons.hexagons(values, weight, bias, stride, *others, own=_convolve_own)


def _convolve_own(values: Tensor, weight: Tensor, bias: Tensor | None, stride: int) -> Tensor:
    vertex_ids = _vertices_of_charts(level_from_num_vertices(values.shape[-1]))
    return _convolve_at(vertex_ids, values, weight, bias, False, True, False)


@constant_table
def _vertices_of_charts(level: int) -> Tensor:
    return chart_vertices(level, torch.device("cpu")).int()


def _convolve_at(
    places: Tensor,
    values: Tensor,
    weight: Tensor,
    bias: Tensor | None,
    is_row: bool,
    border: bool,
    relu: bool,
) -> Tensor:
    """Convolve what five tables of vertices lay out, as ``(B, 5, O, [N,] h, w)``."""
    volumes = (values.unsqueeze(2) if values.ndim == 3 else values).movedim(1, -1)
    result = hex_convolution(volumes, weight, bias, is_row, border, relu, places)
    return _outward(result.unflatten(0, (-1, 5)), values.ndim + 2)


def normalize_and_convolve(
    col: Tensor,
    row: Tensor,
    norm: CrownNorm,
    relu: bool,
    weight: Tensor | None = None,
    bias: Tensor | None = None,
) -> Pair:
    """Normalise rectangles as ``statistics.normalize`` does, in two passes over memory each way, and, given a weight,
    convolve them at stride 1 while they are read: the normalised rectangles are never written.
    """
    if norm.weight is None or norm.groups > 1 or not _operators_fit(col, norm.weight):
        return NotImplemented
    if weight is not None and not _operators_fit(col, weight):
        return NotImplemented
    first, second, mean, variance = crown_normalization(
        _inward(col), _inward(row), norm.weight, norm.bias, weight, bias, norm.eps, norm.per_sample, relu
    )
    _track(norm, mean, variance, col)
    return _outward(first, col.ndim), _outward(second, col.ndim)


def _inward(rectangles: Tensor) -> Tensor:
    """View rectangles ``(B, 5, C, [N,] h, w)`` as operators take them, ``(B, 5, N, h, w, C)``."""
    return (rectangles.unsqueeze(3) if rectangles.ndim == 5 else rectangles).movedim(2, -1)


def _outward(result: Tensor, ndim: int) -> Tensor:
    """Undo ``_inward``."""
    rectangles = result.movedim(-1, 2)
    return rectangles.squeeze(3) if ndim == 5 else rectangles


@torch.no_grad()
def _track(norm: CrownNorm, mean: Tensor, variance: Tensor, col: Tensor) -> None:
    """Let running statistics take a step towards those of a batch, as ``forward`` does in training mode."""
    if not norm.training or norm.running_mean is None:
        return
    assert norm.running_var is not None
    assert norm.num_batches_tracked is not None
    norm.num_batches_tracked.add_(1)
    rate = 1 / float(norm.num_batches_tracked) if norm.momentum is None else norm.momentum
    vertex_ids = 2 * col.numel() // col.shape[2]
    # Through ``data``, as torch's own layers do it: the formulas of a batch keep the running statistics without using
    # them, and would take them for changed where a layer serves camera after camera and operators come in between.
    norm.running_mean.data.lerp_(mean[0], rate)
    norm.running_var.data.lerp_(variance[0] * (vertex_ids / (vertex_ids - 1)), rate)
