# SPDX-License-Identifier: Apache-2.0
"""Batch normalisation of a crown: one set of statistics over the rectangles of both directions."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.modules.batchnorm import _BatchNorm

from sphericalvision.core import ShapeError
from sphericalvision.crown.layout import Crown, check_crown

__all__ = ["CrownBatchNorm2d", "CrownBatchNorm3d"]


class _CrownBatchNorm(_BatchNorm):
    """Batch normalisation whose statistics count every place, border vertices as often as they occur."""

    spatial_dims: int

    def _check_input_dim(self, input: Tensor) -> None:
        """Accept all: the crown is checked as a whole in ``forward``."""

    def forward(self, crown: Crown) -> Crown:  # type: ignore[override]
        check_crown(crown, self.spatial_dims)
        if crown.col.shape[2] != self.num_features:
            raise ShapeError(
                f"crown: expected {self.num_features} channels (dimension 2), got {crown.col.shape[2]}"
            )
        # Both kinds of rectangle have as many places: with the places in one dimension they are one batch.
        col, row = (rectangles.flatten(0, 1).flatten(-2) for rectangles in crown)
        both = super().forward(torch.cat((col, row)))
        col, row = both.chunk(2)  # unlike unbind, its gradient keeps the channels innermost in memory
        return Crown(col.view(crown.col.shape), row.view(crown.row.shape))


class CrownBatchNorm2d(_CrownBatchNorm):
    """Batch normalisation of a crown ``(B, 5, C, h, w)`` over both directions together.

    Arguments, parameters and running statistics are those of ``torch.nn.BatchNorm2d``.

    Raises:
        ShapeError: if the crown is no crown of C channels without hypotheses.

    References:
        Ioffe and Szegedy (2015), "Batch normalization".

    Examples:
        >>> from sphericalvision.crown import to_crown
        >>> crown = CrownBatchNorm2d(3)(to_crown(torch.rand(2, 3, 42)))
        >>> bool(torch.cat((crown.col.flatten(), crown.row.flatten())).mean().abs() < 1e-6)
        True
    """

    spatial_dims = 2


class CrownBatchNorm3d(_CrownBatchNorm):
    """Batch normalisation of a crown of volumes ``(B, 5, C, N, h, w)`` over both directions together.

    Arguments, parameters and running statistics are those of ``torch.nn.BatchNorm3d``.

    Raises:
        ShapeError: if the crown is no crown of C channels with hypotheses.

    Examples:
        >>> from sphericalvision.crown import to_crown
        >>> CrownBatchNorm3d(3)(to_crown(torch.rand(2, 3, 8, 42))).col.shape
        torch.Size([2, 5, 3, 8, 5, 3])
    """

    spatial_dims = 3
