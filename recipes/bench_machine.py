# SPDX-License-Identifier: Apache-2.0
"""What the machine can do at most: a matrix product, planar and spatial convolutions, a copy."""

from __future__ import annotations

from collections.abc import Iterator

import torch
import torch.nn.functional as F
from omegaconf import DictConfig

from sphericalvision.recipes.benchmarking import Comparison

__all__ = ["comparisons"]


def comparisons(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """Peaks; the share of them that a stage reaches says how much is left to gain."""
    size = config.peak_size
    matrix = torch.randn(size, size, device=device)
    yield Comparison(
        f"peak: matrix product, {size} x {size}",
        {"matmul": lambda: matrix @ matrix},
        "matmul",
        2 * size**3 / 1e9,
    )
    side, channels = max(8, size // 16), 64
    image = torch.randn(1, channels, side, side, device=device).contiguous(memory_format=torch.channels_last)
    kernel = torch.randn(channels, channels, 3, 3, device=device).contiguous(
        memory_format=torch.channels_last
    )
    yield Comparison(
        f"peak: convolution 3 x 3, 64 to 64 channels, {side} x {side}",
        {"conv2d": lambda: F.conv2d(image, kernel, padding=1)},
        "conv2d",
        2 * 9 * channels**2 * side**2 / 1e9,
    )
    block = torch.randn(size * size * 4, device=device)
    target = torch.empty_like(block)
    gigabytes = 2 * block.numel() * 4 / 1e9
    yield Comparison(
        f"peak: copy of {block.numel() * 4 / 1e6:.0f} MB",
        {"copy": lambda: target.copy_(block)},
        "copy",
        note=f"A copy moves {gigabytes:.2f} GB through memory, read and write together.",
    )
