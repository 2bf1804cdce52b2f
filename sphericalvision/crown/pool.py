# SPDX-License-Identifier: Apache-2.0
"""Average pooling of a crown, the shortcut of residual blocks that halve the resolution."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from sphericalvision.core import ArgumentError
from sphericalvision.crown.layout import Crown, check_crown, crown_map

__all__ = ["CrownAvgPool2d", "crown_avg_pool2d"]


def crown_avg_pool2d(crown: Crown, stride: int = 2) -> Crown:
    """Average the 3 x 3 places around each kept place; places outside the rectangle are not counted.

    Args:
        crown: rectangles ``(B, 5, C, h, w)``.
        stride: 1, or 2 to keep the vertices of the next coarser level.

    Raises:
        ShapeError: if the crown is no crown without hypotheses.
        ArgumentError: if the stride is neither 1 nor 2, or 2 at level 0.

    Examples:
        >>> import torch
        >>> from sphericalvision.crown import to_crown
        >>> crown_avg_pool2d(to_crown(torch.ones(1, 3, 162))).col.shape
        torch.Size([1, 5, 3, 5, 3])
    """
    check_crown(crown, 2)
    if stride not in (1, 2) or (stride == 2 and crown.level == 0):
        raise ArgumentError(f"stride: expected 1, or 2 above level 0, got {stride} at level {crown.level}")

    def pool(rectangles: Tensor) -> Tensor:
        pooled = F.avg_pool2d(rectangles.flatten(0, 1), 3, stride, padding=1, count_include_pad=False)
        return pooled.unflatten(0, (-1, 5))

    return crown_map(pool, crown)


class CrownAvgPool2d(nn.Module):
    """Average pooling over 3 x 3 places; see ``crown_avg_pool2d``.

    Examples:
        >>> CrownAvgPool2d()
        CrownAvgPool2d(stride=2)
    """

    def __init__(self, stride: int = 2) -> None:
        super().__init__()
        self.stride = stride

    def forward(self, crown: Crown) -> Crown:
        return crown_avg_pool2d(crown, self.stride)

    def extra_repr(self) -> str:
        return f"stride={self.stride}"
