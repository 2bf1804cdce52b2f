# SPDX-License-Identifier: Apache-2.0
"""A choice of time and memory that changes no result: whether training computes the inside of blocks twice."""

from __future__ import annotations

from torch import nn

from sphericalvision.core import ArgumentError
from sphericalvision.crown.recompute import RecomputedModule

__all__ = ["recomputes", "set_kernel_options"]


def set_kernel_options(module: nn.Module, *, recompute: bool) -> None:
    """Choose how the layers inside a network are computed, at any time; the results stay the same.

    Args:
        module: the network, or a part of it.
        recompute: whether training saves memory by computing the inside of blocks twice, for a third more work.

    Raises:
        ArgumentError: if no layer offers that choice.

    Examples:
        >>> from sphericalvision.crown import CrownBlock3d
        >>> block = CrownBlock3d(2, 2, 2)
        >>> set_kernel_options(block, recompute=True)
        >>> recomputes(block)
        True
    """
    parts = [part for part in module.modules() if isinstance(part, RecomputedModule)]
    if recompute and not parts:
        raise ArgumentError(f"recompute: {type(module).__name__} has nothing to choose there; leave it out")
    for part in parts:
        part.recompute = recompute


def recomputes(module: nn.Module) -> bool:
    """Return whether the inside of any block of a network is computed twice in training."""
    return any(part.recompute for part in module.modules() if isinstance(part, RecomputedModule))
