# SPDX-License-Identifier: Apache-2.0
"""Values of tests that are the same each time."""

from __future__ import annotations

import torch
from torch import Tensor


def random_values(*shape: int, seed: int = 1) -> Tensor:
    return torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def weighted_sum(*values: Tensor) -> float:
    """A sum over all numbers, each weighted by where it stands, so that none can change or move unnoticed."""
    numbers = torch.cat([value.detach().double().flatten() for value in values])
    return float(numbers @ torch.arange(1.0, len(numbers) + 1, dtype=torch.float64).cos())


def coarse_sum(*pictures: Tensor) -> float:
    """``weighted_sum`` of means over squares of pictures ``(3, h, w)``: a pixel at an edge changes little."""
    return weighted_sum(*(torch.nn.functional.avg_pool2d(picture, 4) for picture in pictures))
