# SPDX-License-Identifier: Apache-2.0
"""Convolutions with a hexagon's seven taps as operators of torch, computed in C++, for any number of channels.

``hex_convolution.cpp`` takes Winograd's algorithms along every dimension: F(3, 3) along rows and columns, of whose 25
products for nine results two are zero because two corners of the kernel are, and F(4, 3) along the hypotheses. A
result then takes 2.6 products in place of 9 of a planar convolution, or 3.8 in place of 27. Borders are repeated while
reading, not copied around, and nothing but results leaves the cache. So are values at vertices laid out as rectangles:
training then keeps those, half as many, and gradients are added to vertices at once.

The points of F(4, 3) are 0, +-1 / sqrt(2), +-sqrt(2) and infinity, as with the usual +-1 and +-2 in several dimensions
the largest errors would be several times as large; those of F(3, 3) are 0, 1, -1, 2 and infinity.

References:
    Winograd (1980), "Arithmetic complexity of computations"; Lavin and Gray (2016), "Fast algorithms for convolutional
    neural networks", for F(4, 3); Barabasz et al. (2020), "Error analysis and improving the accuracy of Winograd
    convolution for deep neural networks", for the choice of points.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from sphericalvision.crown.fast.registering import Operator
from sphericalvision.crown.places import place_ids
from sphericalvision.crown.taps import COL_TAPS, ROW_TAPS, convolve, planar_kernels, repeat_border
from sphericalvision.tables import constant_table

Scaling = tuple[Tensor | None, Tensor | None]

_TAPS = [list(sum(taps, ())) for taps in (COL_TAPS, ROW_TAPS)]
"""Which tap is at which of nine places, of col and of row rectangles."""


def convolution(
    values: Tensor,
    weight: Tensor,
    bias: Tensor | None,
    across: bool,
    border: bool,
    relu: bool,
    places: Tensor | None = None,
    scaling: Scaling = (None, None),
) -> Tensor:
    """Convolve rectangles or charts of one kind, channels next to each other in memory.

    Args:
        values: volumes ``(B, N, h, w, C)``, whose first and last hypothesis is repeated; or values at vertices,
            ``(B, N, V, C)``, that ``places`` lay out.
        weight: ``(O, C, 21)``, index ``7 * depth + tap``; or ``(O, C, 7)`` where N is 1.
        bias: ``(O,)``.
        across: whether they are row rectangles.
        border: whether there is a border of one more place all around; otherwise theirs is repeated.
        relu: whether the results are rectified, which is not differentiated.
        places: ``(5, h, w)``, int32, vertices that five rectangles a sample are made of.
        scaling: factors and offsets ``(samples or 1, C)`` by which values are multiplied and moved, and then rectified,
            while they are read; not part of the operator.

    Returns:
        ``(B, N, h, w, O)``; of values at vertices five for each sample.
    """
    volumes = _volumes(values, places)
    batch, depth, height, width, _ = volumes.shape
    if places is not None:
        batch, height, width = 5 * batch, *places.shape[1:]
    result = values.new_empty(batch, depth, height - 2 * border, width - 2 * border, len(weight))
    shift = bias if bias is None else bias.contiguous()
    torch.ops.sphericalvision.hex_convolve(
        volumes, weight.contiguous(), _TAPS[across], shift, relu, int(border), result, places, *scaling
    )
    return result


def convolution_gradients(
    upstream: Sequence[Tensor],
    inputs: Sequence[Any],
    statistics: Sequence[Tensor],
    needs_grad: Sequence[bool],
    scaling: Scaling = (None, None),
) -> list[Tensor | None]:
    """Gradients of values, weight and bias: the adjoints of all steps, in reverse.

    With ``scaling`` the first one is that of what was convolved.
    """
    values, weight, _, across, border, relu, places = inputs
    assert not relu
    volumes, gradient = _volumes(values, places), _volumes(upstream[0])
    gradients: list[Tensor | None] = [None] * 4
    if needs_grad[0]:
        gradients[0] = by_values = values.new_zeros(values.shape)
        torch.ops.sphericalvision.hex_convolve_backward_given(
            gradient, weight.contiguous(), _TAPS[across], int(border), _volumes(by_values, places), places
        )
    if needs_grad[1]:
        gradients[1] = by_weight = torch.empty_like(weight, memory_format=torch.contiguous_format)
        torch.ops.sphericalvision.hex_convolve_backward_weight(
            volumes, gradient, _TAPS[across], int(border), by_weight, places, *scaling
        )
    if needs_grad[2]:
        gradients[2] = gradient.sum((0, 1, 2, 3))
    return gradients


def plain_convolution(*inputs: Any) -> Tensor:
    """The same as ``convolution`` in plain torch, of the operator's arguments."""
    values, weight, bias, across, border, relu, places = inputs
    if places is not None:
        laid_out = values.index_select(2, places.flatten()).unflatten(2, places.shape)
        values = laid_out.movedim(2, 1).flatten(0, 1)
    images = values.movedim(-1, 1)
    flat = weight.shape[-1] == 7
    images = images.squeeze(2) if flat else images
    if not border:
        images = repeat_border(images)
    elif not flat:
        images = torch.cat((images[:, :, :1], images, images[:, :, -1:]), 2)
    result = convolve(images, planar_kernels(weight)[int(across)], bias)
    result = (result.unsqueeze(2) if flat else result).movedim(1, -1)
    return result.relu() if relu else result


hex_convolution = Operator(
    "hex_convolution(Tensor values, Tensor weight, Tensor? bias, bool across, bool border, bool relu, Tensor? places) "
    "-> Tensor",
    convolution,
    convolution_gradients,
    plain_convolution,
).forward


@constant_table
def vertices_at_places(level: int) -> tuple[Tensor, Tensor]:
    """``places`` of col and of row rectangles, on the CPU: at level 7 half a megabyte each."""
    n = 2**level
    col, row = place_ids(level, torch.device("cpu")).int().split(5)
    return col.view(5, 2 * n + 1, n + 1), row.view(5, n + 1, 2 * n + 1)


def _volumes(values: Tensor, places: Tensor | None = None) -> Tensor:
    """View values as volumes ``(B, N, h, w, C)``, channels together in memory; vertices as volumes of one row."""
    volumes = values if places is None else values.unsqueeze(2)
    return volumes if volumes.stride(-1) == 1 else volumes.contiguous()
