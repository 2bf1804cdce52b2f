# SPDX-License-Identifier: Apache-2.0
"""A crown on the next coarser level (average and maximum pooling) and on the next finer one (interpolation)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from sphericalvision.core import check_floating
from sphericalvision.crown.layout import Crown, check_crown, crown_map
from sphericalvision.crown.taps import check_stride


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
    check_stride(stride, crown.level)

    def pool(rectangles: Tensor) -> Tensor:
        pooled = F.avg_pool2d(rectangles.flatten(0, 1), 3, stride, padding=1, count_include_pad=False)
        return pooled.unflatten(0, (-1, 5))

    return crown_map(pool, crown)


def crown_max_pool2d(crown: Crown, stride: int = 2) -> Crown:
    """Take the largest of each kept place and its six hexagonal neighbours inside the rectangle.

    Arguments and errors are those of ``crown_avg_pool2d``.

    Examples:
        >>> import torch
        >>> from sphericalvision.crown import to_crown
        >>> crown_max_pool2d(to_crown(torch.ones(1, 3, 162))).row.shape
        torch.Size([1, 5, 3, 3, 5])
    """
    check_crown(crown, 2)
    check_stride(stride, crown.level)

    def pool(rectangles: Tensor) -> Tensor:
        height, width = rectangles.shape[-2:]
        padded = F.pad(rectangles, (1, 1, 1, 1), value=-torch.inf)
        largest = rectangles[..., ::stride, ::stride]
        for row, column in ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1)):
            around = padded[..., row : row + height : stride, column : column + width : stride]
            largest = torch.maximum(largest, around)
        return largest

    return crown_map(pool, crown)


class _CrownPool(nn.Module):
    """Pooling with a stride."""

    def __init__(self, stride: int = 2) -> None:
        super().__init__()
        self.stride = stride

    def extra_repr(self) -> str:
        return f"stride={self.stride}"


class CrownMaxPool2d(_CrownPool):
    """Maximum pooling over a place and its six neighbours; see ``crown_max_pool2d``.

    Examples:
        >>> CrownMaxPool2d()
        CrownMaxPool2d(stride=2)
    """

    def forward(self, crown: Crown) -> Crown:
        return crown_max_pool2d(crown, self.stride)


class CrownAvgPool2d(_CrownPool):
    """Average pooling over 3 x 3 places; see ``crown_avg_pool2d``.

    Examples:
        >>> CrownAvgPool2d()
        CrownAvgPool2d(stride=2)
    """

    def forward(self, crown: Crown) -> Crown:
        return crown_avg_pool2d(crown, self.stride)


def crown_upsample(crown: Crown) -> Crown:
    """Interpolate a crown on the next finer level: new vertices get the mean of their edge.

    A new vertex lies in the middle of an edge between two old ones, so this is exactly the linear interpolation on
    the triangles of the icosphere.

    Args:
        crown: rectangles ``(B, 5, C, h, w)`` or ``(B, 5, C, N, h, w)``; all N hypotheses are kept.

    Raises:
        ShapeError: if the crown is no crown.
        ArgumentError: if it holds integers.

    Examples:
        >>> from sphericalvision.crown import to_crown
        >>> crown_upsample(to_crown(torch.ones(1, 3, 42))).col.shape
        torch.Size([1, 5, 3, 9, 5])
    """
    check_crown(crown)
    check_floating("crown", crown.col)
    return crown_map(_upsample, crown)


def _upsample(rectangles: Tensor) -> Tensor:
    """Edges run along rows, along columns and, in both kinds of rectangle, from lower left to upper right."""
    left, right = rectangles[..., :-1], rectangles[..., 1:]
    even = _interleave(rectangles, (left + right) / 2, -1)
    below = (rectangles[..., :-1, :] + rectangles[..., 1:, :]) / 2
    diagonal = (left[..., 1:, :] + right[..., :-1, :]) / 2
    return _interleave(even, _interleave(below, diagonal, -1), -2)


def _interleave(even: Tensor, odd: Tensor, dim: int) -> Tensor:
    """Slices of two tensors in turn along ``dim`` (negative); ``odd`` has one slice less."""
    length = odd.shape[dim]
    pairs = torch.stack((even.narrow(dim, 0, length), odd), dim).flatten(dim - 1, dim)
    return torch.cat((pairs, even.narrow(dim, length, 1)), dim)


class CrownUpsample(nn.Module):
    """Interpolation on the next finer level; see ``crown_upsample``.

    Examples:
        >>> CrownUpsample()
        CrownUpsample()
    """

    def forward(self, crown: Crown) -> Crown:
        return crown_upsample(crown)
