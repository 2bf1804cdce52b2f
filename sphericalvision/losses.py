# SPDX-License-Identifier: Apache-2.0
"""Losses on hypothesis indices."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from sphericalvision.core import ShapeError

__all__ = ["depth_index_huber"]


def depth_index_huber(
    pred_index: Tensor, target_index: Tensor, mask: Tensor | None = None, delta: float = 1.0
) -> Tensor:
    """Return the mean Huber loss of hypothesis indices over the points of a mask.

    Args:
        pred_index: ``(B, V)`` predicted indices, 0 to N - 1, as from ``soft_argmax``.
        target_index: ``(B, V)`` indices of the ground truth, not rounded.
        mask: ``(B, V)``, True where the ground truth counts; everywhere when not given. Values of the target
            outside the mask have no influence, NaN included.
        delta: index difference at which the loss turns from quadratic to linear.

    Returns:
        A scalar; 0, with zero gradients, if the mask is empty.

    Raises:
        ShapeError: if the shapes differ.

    References:
        Huber (1964), "Robust estimation of a location parameter".

    Examples:
        >>> import torch
        >>> depth_index_huber(torch.tensor([[0.0, 3.0]]), torch.tensor([[1.0, 0.0]]))  # (0.5 + 2.5) / 2
        tensor(1.5000)
    """
    if pred_index.shape != target_index.shape:
        raise ShapeError(
            f"target_index: expected the shape of pred_index {tuple(pred_index.shape)}, "
            f"got {tuple(target_index.shape)}"
        )
    if mask is None:
        return F.huber_loss(pred_index, target_index, delta=delta)
    if mask.shape != pred_index.shape:
        raise ShapeError(f"mask: expected shape {tuple(pred_index.shape)}, got {tuple(mask.shape)}")
    target = target_index.where(mask, pred_index.detach())
    total = F.huber_loss(pred_index, target, delta=delta, reduction="sum")
    return total / mask.sum().clamp(min=1)
