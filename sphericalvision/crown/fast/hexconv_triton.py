# SPDX-License-Identifier: Apache-2.0
"""Hexagonal convolutions as one kernel for CUDA devices, in Triton: what seven taps read is never written."""

from __future__ import annotations

import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

VERTICES, OUTPUTS, INPUTS = 32, 32, 32
"""Of a program: its vertices and output channels at most, and the input channels that it multiplies together."""


@triton.jit  # type: ignore[no-untyped-def, unused-ignore]
def _tap(first, ids, channel, within, strides_vertex, strides_channel, RECTIFY: tl.constexpr):  # type: ignore[no-untyped-def]
    values = tl.load(
        first + ids[:, None] * strides_vertex + channel * strides_channel, mask=within, other=0.0
    )
    return tl.maximum(values, 0.0) if RECTIFY else values


@triton.jit  # type: ignore[no-untyped-def, unused-ignore]
def _kernel(  # type: ignore[no-untyped-def]
    values, weight, bias, residual, taps, around, result, number, vertices, outputs,
    value_batch, value_channel, value_vertex, residual_batch, residual_channel, residual_vertex,
    CHANNELS: tl.constexpr, VERTICES: tl.constexpr, OUTPUTS: tl.constexpr, INPUTS: tl.constexpr,
    RECTIFY: tl.constexpr, BIAS: tl.constexpr, RESIDUAL: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    vertex = tl.program_id(0) * VERTICES + tl.arange(0, VERTICES)
    output = tl.program_id(1) * OUTPUTS + tl.arange(0, OUTPUTS)[None, :]
    batch = tl.program_id(2).to(tl.int64)
    here, used = vertex < vertices, output < outputs
    first = values + batch * value_batch
    total = tl.zeros((VERTICES, OUTPUTS), tl.float32)
    for tap in range(7):
        ids = tl.load(taps + vertex * 7 + tap, mask=here, other=0)
        is_gap = ids >= number
        any_gap = tl.max(is_gap.to(tl.int32), axis=0)
        for start in range(0, CHANNELS, INPUTS):
            channel = start + tl.arange(0, INPUTS)[None, :]
            within = here[:, None] & (channel < CHANNELS)
            block = _tap(
                first, ids, channel, within & (ids < number)[:, None], value_vertex, value_channel, RECTIFY
            )
            if any_gap > 0:  # the mean of the five neighbours of one of the twelve vertices
                # Read again: what was read outside has another layout, which Triton does not carry into a branch.
                inner = tl.load(taps + vertex * 7 + tap, mask=here, other=0)
                for place in range(5):
                    beside = tl.load(around + (inner - number) * 5 + place, mask=inner >= number, other=0)
                    gap = within & (inner >= number)[:, None]
                    block += _tap(first, beside, channel, gap, value_vertex, value_channel, RECTIFY) / 5
            rows = start + tl.arange(0, INPUTS)[:, None]
            kernel = tl.load(
                weight + (output * CHANNELS + rows) * 7 + tap, mask=used & (rows < CHANNELS), other=0.0
            )
            total = tl.dot(block, kernel, total, input_precision=PRECISION)
    if BIAS:
        total += tl.load(bias + output, mask=used, other=0.0)
    if RESIDUAL:
        place = (
            residual + batch * residual_batch + vertex[:, None] * residual_vertex + output * residual_channel
        )
        total += tl.load(place, mask=here[:, None] & used, other=0.0)
    tl.store(
        result + (batch * vertices + vertex[:, None]) * outputs + output, total, mask=here[:, None] & used
    )


def hex_conv_kernel(
    values: Float[Tensor, "B C_in V"],
    weight: Float[Tensor, "C_out C_in 7"],
    bias: Float[Tensor, " C_out"] | None,
    around: Int[Tensor, " rings_times_5"],
    taps: Int[Tensor, " V_out_times_7"],
    rectify: bool = False,
    residual: Float[Tensor, "B C_out V_out"] | None = None,
) -> Float[Tensor, "B C_out V_out"]:
    """Return what ``lookups.hexagons2d`` returns, of float32; channels are the fastest in memory.

    Products are as exact as three of TF32 make them.

    Args:
        values: ``(B, in, V)``, laid out in any way.
        weight: ``(out, in, 7)``.
        bias: ``(out,)``.
        around: five neighbours of the twelve special vertices.
        taps: seven of each vertex, V + s for the mean of what is around a special one.
        rectify: whether values pass a ReLU first.
        residual: is added.
    """
    batch, channels, number = values.shape
    outputs, vertices = len(weight), len(taps) // 7
    result = values.new_empty(batch, vertices, outputs).mT
    # Products of matrices take 16 rows and columns at least.
    width, depth = (
        max(16, min(most, triton.next_power_of_2(size)))
        for most, size in ((OUTPUTS, outputs), (INPUTS, channels))
    )
    added = result if residual is None else residual
    _kernel[(triton.cdiv(vertices, VERTICES), triton.cdiv(outputs, width), batch)](
        values, weight.contiguous(), weight if bias is None else bias, added, taps, around, result,
        number, vertices, outputs, *values.stride(), *added.stride(),
        CHANNELS=channels, VERTICES=VERTICES, OUTPUTS=width, INPUTS=depth,
        RECTIFY=rectify, BIAS=bias is not None, RESIDUAL=residual is not None, PRECISION="tf32x3",
    )  # fmt: skip
    return result
