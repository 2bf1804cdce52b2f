# SPDX-License-Identifier: Apache-2.0
"""What the machine can do at most: a matrix product, a convolution, a copy."""

from __future__ import annotations

from collections.abc import Iterator

import torch
import torch.nn.functional as F
from omegaconf import DictConfig

from sphericalvision.recipes.benchmark.measuring import BF16, Comparison

__all__ = ["comparisons"]


def comparisons(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """Peaks; the share of them that a stage reaches says how much is left to gain."""
    size = config.peak_size
    side, channels = max(8, size // 16), 64
    dtypes = {"": torch.float32}
    if "bf16" in config.options:  # without the instructions for it a matrix product takes minutes
        dtypes[BF16] = torch.bfloat16
    for suffix, dtype in dtypes.items():
        matrix = torch.randn(size, size, device=device, dtype=dtype)
        name = f"matmul{suffix}"
        yield Comparison(
            f"peak: matrix product{suffix}, {size} x {size}",
            {name: lambda matrix=matrix: matrix @ matrix},
            name,
            2 * size**3 / 1e9,
            peak="FLOP",
        )
        image = torch.randn(1, channels, side, side, device=device, dtype=dtype)
        kernel = torch.randn(channels, channels, 3, 3, device=device, dtype=dtype)
        image, kernel = (x.contiguous(memory_format=torch.channels_last) for x in (image, kernel))
        name = f"conv2d{suffix}"
        yield Comparison(
            f"peak: convolution 3 x 3{suffix}, 64 to 64 channels, {side} x {side}",
            {name: lambda image=image, kernel=kernel: F.conv2d(image, kernel, padding=1)},
            name,
            2 * 9 * channels**2 * side**2 / 1e9,
            peak="FLOP",
        )
    block = torch.randn(size * size * 4, device=device)
    target = torch.empty_like(block)
    yield Comparison(
        f"peak: copy of {block.numel() * 4 / 1e6:.0f} MB, read and written",
        {"copy": lambda: target.copy_(block)},
        "copy",
        gbyte=2 * block.numel() * 4 / 1e9,
        peak="byte",
    )
