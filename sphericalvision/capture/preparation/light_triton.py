# SPDX-License-Identifier: Apache-2.0
"""Medians and small systems of equations as one kernel each for CUDA devices, in Triton.

A device takes some ten operators a column of a system, and goes through a row with a sixty-fourth of itself for a
median; the estimate of light asks for nine systems and eight medians, one after the other.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

BLOCK = 8192
"""Values that a program looks at together."""
LARGEST_SYSTEM = 127
"""Equations whose coefficients and right side fit into the registers of a program."""


@triton.jit  # type: ignore[no-untyped-def, unused-ignore]
def _median(values, result, number: tl.constexpr, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    row = values + tl.program_id(0).to(tl.int64) * number
    places = tl.arange(0, BLOCK)
    present = tl.zeros((BLOCK,), tl.int32)
    for start in range(0, number, BLOCK):
        value = tl.load(row + start + places, mask=start + places < number, other=float("nan"))
        present += (value == value).to(tl.int32)
    count = tl.sum(present, axis=0)
    rank = (count - 1) // 2
    # The bits of floats of one sign are in their order. Two bits a pass, from the highest on, tell how many values are
    # smaller than those that begin with them.
    found = 0
    for turn in range(16):
        shift = 30 - 2 * turn
        smaller = tl.zeros((BLOCK,), tl.int32)
        smaller_by_two = tl.zeros((BLOCK,), tl.int32)
        smaller_by_three = tl.zeros((BLOCK,), tl.int32)
        step = 1 << shift
        for start in range(0, number, BLOCK):
            value = tl.load(row + start + places, mask=start + places < number, other=float("nan"))
            valid = value == value
            # The highest bit is the sign's, 0 in all of them.
            bits = value.to(tl.float32).to(tl.int32, bitcast=True) - found
            smaller += (valid & (bits < step)).to(tl.int32)
            if turn > 0:
                smaller_by_two += (valid & (bits < 2 * step)).to(tl.int32)
                smaller_by_three += (valid & (bits < 3 * step)).to(tl.int32)
        above = (tl.sum(smaller, axis=0) <= rank).to(tl.int32)
        if turn > 0:
            above += (tl.sum(smaller_by_two, axis=0) <= rank).to(tl.int32)
            above += (tl.sum(smaller_by_three, axis=0) <= rank).to(tl.int32)
        found += above * step
    median = found.to(tl.float32, bitcast=True)  # type: ignore[attr-defined]
    tl.store(result + tl.program_id(0), tl.where(count > 0, median, float("nan")))


def nanmedian_kernel(values: Float[Tensor, "rows number"]) -> Float[Tensor, " rows"]:
    """Return the lower median of each row without its NaNs, NaN where there is nothing else, as float32.

    Args:
        values: ``(rows, number)``, 0 or more, floating point.
    """
    values = values.contiguous()
    result = values.new_empty(len(values), dtype=torch.float32)
    _median[(len(values),)](values, result, values.shape[1], BLOCK=BLOCK, num_warps=32)
    return result


@triton.jit  # type: ignore[no-untyped-def, unused-ignore]
def _eliminate(matrix, right, result, number: tl.constexpr, SIZE: tl.constexpr):  # type: ignore[no-untyped-def]
    system = tl.program_id(0)
    row, column = tl.arange(0, SIZE)[:, None], tl.arange(0, SIZE)[None, :]
    first = matrix + system * number * number
    values = tl.load(first + row * number + column, mask=(row < number) & (column < number), other=0.0)
    target = tl.load(right + system * number + row, mask=row < number, other=0.0)
    values = tl.where(column == number, target, values)
    for place in range(number):
        own = tl.sum(tl.where(row == place, values, 0.0), axis=0)[None, :]
        own = own / tl.sum(tl.where(column == place, own, 0.0), axis=1)[:, None]
        others = tl.sum(tl.where(column == place, values, 0.0), axis=1)[:, None] - tl.where(
            row == place, 1.0, 0.0
        )
        values -= others * own
    answer = tl.sum(tl.where(column == number, values, 0.0), axis=1)
    places = tl.arange(0, SIZE)
    tl.store(result + system * number + places, answer, mask=places < number)


def elimination_kernel(
    matrix: Float[Tensor, "*b n n"], right: Float[Tensor, "*b n"]
) -> Float[Tensor, "*b n"]:
    """Return what ``photometry.eliminated`` returns, of ``LARGEST_SYSTEM`` unknowns at most.

    Args:
        matrix: ``(*b, n, n)``, positive definite.
        right: ``(*b, n)``.
    """
    number = right.shape[-1]
    matrix, right = matrix.contiguous(), right.contiguous()
    result = torch.empty_like(right)
    size = max(triton.next_power_of_2(number + 1), 16)
    _eliminate[(right.numel() // number,)](
        matrix, right, result, number, SIZE=size, num_warps=min(32, max(1, size * size // 128))
    )
    return result
