# SPDX-License-Identifier: Apache-2.0
"""The bilateral filter as one kernel for CUDA devices, in Triton, which torch for CUDA brings along."""

from __future__ import annotations

import math
from functools import cache

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

BLOCK = 256
"""Pixels of a program."""


@triton.jit  # type: ignore[no-untyped-def, unused-ignore]
def _kernel(  # type: ignore[no-untyped-def]
    image, result, steepness, nearness, height, width, C: tl.constexpr, R: tl.constexpr, BLOCK: tl.constexpr
):
    pixels = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    frame = tl.program_id(1)
    plane = height * width
    inside = pixels < plane
    y, x = pixels // width, pixels % width
    channels = tl.arange(0, 4)  # a power of two; the fourth is not loaded
    within = (channels < C)[:, None] & inside[None, :]
    first = image + frame * C * plane + channels[:, None] * plane
    middle = tl.load(first + pixels[None, :], mask=within, other=0.0)
    steep = tl.load(steepness + frame)
    weights = tl.zeros((BLOCK,), tl.float32)
    total = tl.zeros((4, BLOCK), tl.float32)
    for down in tl.static_range(-R, R + 1):
        for across in tl.static_range(-R, R + 1):
            if down * down + across * across <= R * R:
                # Reflected at the edges without repeating them, as ``F.pad(mode="reflect")`` and OpenCV do it.
                row, column = tl.abs(y + down), tl.abs(x + across)
                row = tl.where(row >= height, 2 * height - 2 - row, row)
                column = tl.where(column >= width, 2 * width - 2 - column, column)
                moved = tl.load(first + (row * width + column)[None, :], mask=within, other=0.0)
                difference = tl.sum(tl.abs(moved - middle), axis=0)
                near = tl.load(nearness + (down + R) * (2 * R + 1) + across + R)
                weight = near * tl.exp(difference * difference * steep)
                weights += weight
                total += weight[None, :] * moved
    target = result + frame * C * plane + channels[:, None] * plane + pixels[None, :]
    tl.store(target, total / weights[None, :], mask=within)


@cache
def _nearness(radius: int, reach: float, device: torch.device) -> Tensor:
    """The weights of the pixels around, by their distance alone, row by row."""
    side = range(-radius, radius + 1)
    weights = [math.exp(-0.5 * (y * y + x * x) / reach**2) for y in side for x in side]
    return torch.tensor(weights, device=device)


def bilateral_kernel(
    image: Float[Tensor, "b c h w"], steepness: Float[Tensor, " b"], radius: int, reach: float
) -> Float[Tensor, "b c h w"]:
    """Return what ``preparation.bilateral`` returns, in one pass over the pixels.

    Args:
        image: ``(b, c, h, w)`` float32 on a CUDA device, of up to four channels, both sides longer than ``radius``.
        steepness: ``(b,)``, what squared differences of colours are multiplied with in the exponent, at most 0.
        radius: of the disc of pixels.
        reach: standard deviation of the weights over it, in pixels.
    """
    image = image.contiguous()
    frames, channels, height, width = image.shape
    result = torch.empty_like(image)
    _kernel[(triton.cdiv(height * width, BLOCK), frames)](
        image, result, steepness.contiguous(), _nearness(radius, reach, image.device), height, width,
        C=channels, R=radius, BLOCK=BLOCK,
    )  # fmt: skip
    return result
