# SPDX-License-Identifier: Apache-2.0
"""The ten rectangles of a crown on one sheet."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from torch import Tensor

from sphericalvision.core import ShapeError
from sphericalvision.crown import Crown
from sphericalvision.crown.layout import check_crown
from sphericalvision.viz.color import DEPTH_MAP, colorize
from sphericalvision.viz.figure import sheet

__all__ = ["crown_picture"]

Picture = npt.NDArray[Any]


def crown_picture(crown: Crown, low: float = 0.0, high: float = 1.0, scale: int = 1) -> Picture:
    """Draw the five upright and, below them, the five lying rectangles of a crown.

    Neighbouring rectangles share their border, and both rows show the whole sphere: each vertex stands in
    several places.

    Args:
        crown: of one sample, ``(1, 5, C, ...)`` with C = 3 (RGB) or 1 (coloured by size), without hypotheses.
        low: value shown as black or blue.
        high: value shown as white or red.
        scale: pixels a vertex.

    Returns:
        uint8 ``(h, w, 3)``.

    Raises:
        ShapeError: more than one sample, other than 1 or 3 channels, or a volume of hypotheses.

    Examples:
        >>> import torch
        >>> from sphericalvision.crown import to_crown
        >>> crown_picture(to_crown(torch.rand(1, 3, 162)), scale=8).dtype
        dtype('uint8')
    """
    check_crown(crown)
    for values in (crown.col, crown.row):
        if values.ndim != 5 or values.shape[0] != 1 or values.shape[2] not in (1, 3):
            raise ShapeError(f"crown: expected rectangles (1, 5, 1 or 3, h, w), got {tuple(values.shape)}")
    rows = [[_paint(chart, low, high, scale) for chart in values[0]] for values in (crown.col, crown.row)]
    strips = [sheet(row, columns=5) for row in rows]
    return sheet({"col: five upright rectangles": strips[0], "row: five lying rectangles": strips[1]})


def _paint(chart: Tensor, low: float, high: float, scale: int) -> Picture:
    """One rectangle (C, h, w) as uint8 (h * scale, w * scale, 3)."""
    scaled = ((chart.detach().cpu().double() - low) / (high - low)).clamp(0, 1)
    if len(scaled) == 1:
        colors = colorize(scaled[0].numpy(), DEPTH_MAP)
    else:
        colors = (scaled.movedim(0, -1).numpy() * 255).round().astype(np.uint8)
    return colors.repeat(scale, axis=0).repeat(scale, axis=1)
