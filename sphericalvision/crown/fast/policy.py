# SPDX-License-Identifier: Apache-2.0
"""Whether the fast ways may step in at all, and whether they do so even where they do not pay."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from sphericalvision.core import uses_reference_kernels

__all__ = ["available", "forced", "wherever_possible"]

_forced_blocks = 0


def available() -> bool:
    """Whether fast ways may step in: not under ``reference_kernels``, for compilers, which are slow at many slices, or
    inside the transforms of ``torch.func``, which take functions apart that torch knows."""
    transformed = torch._C._are_functorch_transforms_active()
    return not (uses_reference_kernels() or torch.compiler.is_compiling() or transformed)


def forced() -> bool:
    """Whether fast ways step in wherever they can."""
    return _forced_blocks > 0


@contextmanager
def wherever_possible() -> Iterator[None]:
    """Take the fast ways inside at any size and in any precision: to compare them with the reference, in float64."""
    global _forced_blocks
    _forced_blocks += 1
    try:
        yield
    finally:
        _forced_blocks -= 1
