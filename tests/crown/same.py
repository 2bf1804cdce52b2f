# SPDX-License-Identifier: Apache-2.0
"""Two ways to compute one thing, compared in both passes."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def assert_same_values_and_gradients(
    result: Tensor, expected: Tensor, inputs: Sequence[Tensor], generator: torch.Generator
) -> None:
    """Values agree, and so do the gradients of every input for one random gradient of the outcome."""
    torch.testing.assert_close(result, expected)
    upstream = torch.randn(expected.shape, generator=generator, dtype=expected.dtype)
    ours, theirs = (torch.autograd.grad(way, inputs, upstream) for way in (result, expected))
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other)
