# SPDX-License-Identifier: Apache-2.0
"""Reading values on a grid: checks of their shape, and weighted sums of a few of them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from sphericalvision.core import ArgumentError, ShapeError

__all__ = ["check_positive", "check_values", "sum_of_taps"]


def check_positive(**sizes: int) -> None:
    """Raise ``ArgumentError`` unless every size is a whole number of 1 or more.

    Examples:
        >>> check_positive(height=4, width=8)
    """
    for name, size in sizes.items():
        if isinstance(size, bool) or not isinstance(size, int) or size < 1:
            raise ArgumentError(f"{name}: expected a positive number of pixels, got {size!r}")


def check_values(values: Tensor, shape: Sequence[int]) -> None:
    """Raise ``ShapeError`` unless ``values`` is ``(*b, c, *shape)``.

    Examples:
        >>> check_values(torch.zeros(3, 4, 8), (4, 8))
    """
    if values.ndim <= len(shape) or tuple(values.shape[-len(shape) :]) != tuple(shape):
        size = ", ".join(map(str, shape))
        raise ShapeError(f"values: expected shape (*b, c, {size}), got {tuple(values.shape)}")


def sum_of_taps(values: Tensor, ids: Tensor, weights: Tensor) -> Tensor:
    """Weighted sums ``(*b, c, n)`` of ``values`` ``(*b, c, v)``.

    Args:
        values: floating point.
        ids: ``(*b, n, m)``, or ``(n, m)`` for all of the batch: which m values are read for each of n sums.
        weights: of the ids' shape.

    Examples:
        >>> sum_of_taps(torch.tensor([[1.0, 5.0]]), torch.tensor([[0, 1]]), torch.tensor([[0.25, 0.75]]))
        tensor([[4.]])
    """
    weights = weights.to(values.dtype)
    if ids.ndim == 2:  # whole rows of channels are read at once
        rows = values.reshape(values.shape[:-1].numel(), values.shape[-1]).t().contiguous()
        if torch.is_grad_enabled() and (values.requires_grad or weights.requires_grad):
            found = rows.index_select(0, ids[:, 0]) * weights[:, :1]
            for k in range(1, ids.shape[-1]):
                found = found + rows.index_select(0, ids[:, k]) * weights[:, k, None]
        else:  # faster, but has no second derivatives
            found = F.embedding_bag(ids, rows, per_sample_weights=weights, mode="sum")
        return found.t().reshape(*values.shape[:-1], len(ids)).contiguous()
    batch = torch.broadcast_shapes(values.shape[:-2], ids.shape[:-2])
    values = values.expand(*batch, *values.shape[-2:])
    shape = (*batch, values.shape[-2], ids.shape[-2])
    total = values.new_zeros(())
    for k in range(ids.shape[-1]):
        total = total + values.gather(-1, ids[..., None, :, k].expand(shape)) * weights[..., None, :, k]
    return total
