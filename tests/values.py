# SPDX-License-Identifier: Apache-2.0
"""Values of tests that are the same each time."""

from __future__ import annotations

import torch
from torch import Tensor


def random_values(*shape: int, seed: int = 1) -> Tensor:
    return torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
