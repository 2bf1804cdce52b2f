# SPDX-License-Identifier: Apache-2.0
"""The shape that several shapes broadcast to."""

from __future__ import annotations

from collections.abc import Sequence

import torch

__all__ = ["broadcast_shapes"]


def broadcast_shapes(*shapes: Sequence[int]) -> torch.Size:
    """What ``torch.broadcast_shapes`` returns, but that imports SymPy when first called, half a second.

    Raises:
        RuntimeError: the shapes do not broadcast.

    Examples:
        >>> broadcast_shapes((3, 1), (4,), ())
        torch.Size([3, 4])
    """
    number = torch.empty(())
    return torch.broadcast_tensors(number, *(number.expand(tuple(shape)) for shape in shapes))[0].shape
