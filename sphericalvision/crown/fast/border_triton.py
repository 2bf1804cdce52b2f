# SPDX-License-Identifier: Apache-2.0
"""Rectangles continued by their border values, as one kernel each way for CUDA devices, in Triton.

Torch's own for volumes takes six times as long as memory does, and adds gradients up in an order that changes.
"""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

BLOCK = 1024
"""Values of the result that a program writes."""


@triton.jit  # type: ignore[no-untyped-def, unused-ignore]
def _repeat(images, result, depth, height, width, number, AROUND: tl.constexpr, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    image = tl.program_id(1).to(tl.int64)
    inside = place < number
    x, rest = place % (width + 2), place // (width + 2)
    y, z = rest % (height + 2), rest // (height + 2)
    x, y = tl.minimum(tl.maximum(x - 1, 0), width - 1), tl.minimum(tl.maximum(y - 1, 0), height - 1)
    z = tl.minimum(tl.maximum(z - AROUND, 0), depth - 1)
    values = tl.load(images + image * depth * height * width + (z * height + y) * width + x, mask=inside)
    tl.store(result + image * number + place, values, mask=inside)


@triton.jit  # type: ignore[no-untyped-def, unused-ignore]
def _sum(padded, result, depth, height, width, number, AROUND: tl.constexpr, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    image = tl.program_id(1).to(tl.int64)
    inside = place < number
    x, rest = place % width, place // width
    y, z = rest % height, rest // height
    first = padded + image * (depth + 2 * AROUND) * (height + 2) * (width + 2)
    total = tl.zeros((BLOCK,), tl.float32)
    for back in tl.static_range(-AROUND, AROUND + 1):
        for down in tl.static_range(-1, 2):
            for right in tl.static_range(-1, 2):
                # What lies beyond the border is a copy of the place at the border.
                copied = inside
                if back != 0:
                    copied &= (z + back < 0) | (z + back >= depth)
                if down != 0:
                    copied &= (y + down < 0) | (y + down >= height)
                if right != 0:
                    copied &= (x + right < 0) | (x + right >= width)
                row = (z + AROUND + back) * (height + 2) + y + 1 + down
                total += tl.load(first + row * (width + 2) + x + 1 + right, mask=copied, other=0.0).to(
                    tl.float32
                )
    tl.store(result + image * number + place, total, mask=inside)


def _run(kernel: Any, values: Tensor, more: int) -> Tensor:
    """Apply a kernel to ``(B, C, [N,] h, w)``; ``more`` is by how much each of the last sizes grows."""
    values = values.contiguous()
    batch, channels, *sizes = values.shape
    result = values.new_empty(batch, channels, *(size + more for size in sizes))
    depth, height, width = [1, *(min(size, size + more) for size in sizes)][-3:]
    number = result[0, 0].numel()
    # A grid's second dimension holds 65,535 at most, its first any number.
    kernel[(triton.cdiv(number, BLOCK), batch * channels)](
        values, result, depth, height, width, number, AROUND=len(sizes) - 2, BLOCK=BLOCK
    )
    return result


class RepeatBorder(torch.autograd.Function):
    """``taps.repeat_border`` of ``(B, C, [N,] h, w)``; the adjoint is ``SumBorder``."""

    @staticmethod
    def forward(ctx: Any, images: Float[Tensor, "B C *N h w"]) -> Float[Tensor, "B C *N_padded h+2 w+2"]:
        return _run(_repeat, images, 2)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        return SumBorder.apply(*gradients)  # type: ignore[no-any-return]


class SumBorder(torch.autograd.Function):
    """Add what lies beyond the border to the places that it repeats; the adjoint is ``RepeatBorder``."""

    @staticmethod
    def forward(ctx: Any, padded: Float[Tensor, "B C *N_padded h+2 w+2"]) -> Float[Tensor, "B C *N h w"]:
        return _run(_sum, padded, -2)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        return RepeatBorder.apply(*gradients)  # type: ignore[no-any-return]
