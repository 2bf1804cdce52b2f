# SPDX-License-Identifier: Apache-2.0
"""Checks of sizes of grids and of values on them."""

from __future__ import annotations

from collections.abc import Sequence

from jaxtyping import Shaped
from torch import Tensor

from sphericalvision.core import ArgumentError, ShapeError, check_tensor

__all__ = ["MAX_CELLS", "check_cells", "check_positive", "check_values"]


MAX_CELLS = 2**27
"""The largest grid: a panorama of 8192 x 16384 pixels, whose directions take 1.5 GB in float32."""


def check_cells(count: int, **sizes: int) -> None:
    """Raise ``ArgumentError`` unless a grid of these sizes has no more than ``MAX_CELLS`` values.

    Examples:
        >>> check_cells(4 * 8, height=4, width=8)
    """
    if count > MAX_CELLS:
        given = ", ".join(map(str, sizes.values()))
        raise ArgumentError(
            f"{', '.join(sizes)}: expected a grid of {MAX_CELLS:,} values at most (8192 x 16384), got {given}, "
            f"which makes {count:,}; take a smaller one"
        )


def check_positive(**sizes: int) -> None:
    """Raise ``ArgumentError`` unless every size is a whole number of 1 or more.

    Examples:
        >>> check_positive(height=4, width=8)
    """
    for name, size in sizes.items():
        if isinstance(size, bool) or not isinstance(size, int) or size < 1:
            raise ArgumentError(f"{name}: expected a positive number of pixels, got {size!r}")


def check_values(values: Shaped[Tensor, " ..."], shape: Sequence[int]) -> None:
    """Raise ``ShapeError`` unless ``values`` is ``(*b, c, *shape)``.

    Examples:
        >>> import torch
        >>> check_values(torch.zeros(3, 4, 8), (4, 8))
    """
    check_tensor("values", values, f"(*b, c, {', '.join(map(str, shape))})")
    if values.ndim <= len(shape) or tuple(values.shape[-len(shape) :]) != tuple(shape):
        size = ", ".join(map(str, shape))
        raise ShapeError(f"values: expected shape (*b, c, {size}), got {tuple(values.shape)}")
