# SPDX-License-Identifier: Apache-2.0
"""Numbers to colours: depth on an inverse-depth scale, errors on a linear one, unknown in grey."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch

from sphericalvision.core import ArgumentError, check_choice

Picture = npt.NDArray[np.uint8]
Values = torch.Tensor | npt.NDArray[Any]

UNKNOWN_GREY = 128
"""Grey level of points without a value."""

DEPTH_MAP, ERROR_MAP = "turbo", "inferno"


def depth_to_color(depth: Values, min_depth: float, max_depth: float = math.inf) -> Picture:
    """Colour depth evenly in inverse depth: red at ``min_depth``, dark blue at ``max_depth``, grey unknown.

    Args:
        depth: ``(*)`` metres; infinity is far away, NaN, zero and negative values are unknown.
        min_depth: metres; nearer points have the colour of it.
        max_depth: metres; farther points have the colour of it.

    Returns:
        uint8 ``(*, 3)``, RGB.

    Raises:
        ArgumentError: unless 0 < ``min_depth`` < ``max_depth``.

    Examples:
        >>> depth_to_color(torch.tensor([0.5, torch.inf, torch.nan]), min_depth=0.5).tolist()
        [[122, 4, 3], [48, 18, 59], [128, 128, 128]]
    """
    _check_depth_range(min_depth, max_depth)
    values = _to_numpy(depth)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(values > 0, 1 / values, np.nan)
    return colorize((inverse - 1 / max_depth) / (1 / min_depth - 1 / max_depth), DEPTH_MAP)


def error_to_color(error: Values, max_error: float) -> Picture:
    """Colour errors, black at 0 to pale yellow at ``max_error`` and beyond; NaN is grey.

    Args:
        error: ``(*)``, in any unit; the sign does not count.
        max_error: in the same unit.

    Returns:
        uint8 ``(*, 3)``, RGB.

    Raises:
        ArgumentError: ``max_error`` is not positive.

    Examples:
        >>> error_to_color(torch.tensor([0.0, -9.0, torch.nan]), max_error=5.0).tolist()
        [[0, 0, 4], [252, 255, 164], [128, 128, 128]]
    """
    if not 0 < max_error < math.inf:
        raise ArgumentError(f"max_error: expected a positive number, got {max_error!r}")
    return colorize(np.abs(_to_numpy(error)) / max_error, ERROR_MAP)


def depth_ticks(
    min_depth: float, max_depth: float = math.inf, spacing: float = 0.07
) -> list[tuple[float, str]]:
    """Round depths for a scale, as pairs (position from 0, far, to 1, near; label in metres).

    Positions are at least ``spacing`` apart.

    Examples:
        >>> depth_ticks(1.0, spacing=0.2)
        [(1.0, '1'), (0.666..., '1.5'), (0.333..., '3'), (0.0, '∞')]
    """
    _check_depth_range(min_depth, max_depth)
    far, near = 1 / max_depth, 1 / min_depth
    ends = [min_depth, max_depth]
    round_depths = [digit * 10.0**power for power in range(-3, 5) for digit in (1, 1.5, 2, 3, 5, 7)]
    positions = {depth: (1 / depth - far) / (near - far) for depth in [*ends, *round_depths]}
    chosen = list(ends)
    for depth in sorted(round_depths):
        if all(abs(positions[depth] - positions[other]) >= spacing for other in chosen) and (
            min_depth < depth < max_depth
        ):
            chosen.append(depth)
    return [(positions[depth], "∞" if math.isinf(depth) else f"{depth:.3g}") for depth in sorted(chosen)]


def fade(colors: Picture, strength: Values) -> Picture:
    """Mix colours ``(*, 3)`` with the grey of unknown points: all colour at strength ``(*)`` 1, all grey at 0.

    Examples:
        >>> fade(np.array([[208, 8, 128]], np.uint8), torch.tensor([0.5])).tolist()
        [[168, 68, 128]]
    """
    strength_of_pixel = np.clip(np.nan_to_num(_to_numpy(strength)), 0, 1)[..., None]
    mixed = strength_of_pixel.astype(np.float32) * (colors.astype(np.float32) - UNKNOWN_GREY) + UNKNOWN_GREY
    return np.rint(mixed).astype(np.uint8)


def near_end(depth: Values, min_depth: float) -> float:
    """Return a round depth in metres for the red end of a scale, near the nearest surfaces.

    Few scenes have surfaces at ``min_depth``; with red there all others would be dark blue.

    Args:
        depth: ``(*)`` metres, evenly spread; NaN is unknown. A hundredth of the known ones may be nearer.
        min_depth: metres; the result is not below.

    Examples:
        >>> near_end(torch.linspace(1.3, 9.0, 1000), min_depth=0.1)
        1.2
    """
    values = _to_numpy(depth)
    values = values[values > 0]
    if not len(values):
        return min_depth
    nearest = float(np.quantile(np.minimum(values, 1e6), 0.01))
    rounded = [
        digit * 10.0**power for power in range(-4, 6) for digit in _ROUND if digit * 10.0**power <= nearest
    ]
    return max([min_depth, *(float(f"{depth:.2g}") for depth in rounded[-1:])])


_ROUND = (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8)


def _check_depth_range(min_depth: float, max_depth: float) -> None:
    if not 0 < min_depth < max_depth:
        raise ArgumentError(
            f"min_depth, max_depth: expected 0 < min_depth < max_depth in metres, got {min_depth!r}, "
            f"{max_depth!r}"
        )


def _to_numpy(values: Values) -> npt.NDArray[np.float64]:
    if isinstance(values, torch.Tensor):
        values = values.detach().cpu().numpy()
    return np.asarray(values, dtype=np.float64)


def colorize(scaled: npt.NDArray[np.float64], color_map: str) -> Picture:
    """Map values (*) in [0, 1] to uint8 colours (*, 3) by a colour map of OpenCV, in lower case; NaN becomes grey."""
    table = _table(color_map)
    unknown = np.isnan(scaled)
    positions = (np.clip(np.where(unknown, 0, scaled), 0, 1) * (len(table) - 1)).astype(np.int64)
    positions = np.minimum(positions, len(table) - 2)
    return table[np.where(unknown, len(table) - 1, positions)]


@lru_cache(maxsize=8)
def _table(color_map: str) -> Picture:
    """The colours of a map of OpenCV, and after them the grey of unknown points."""
    codes = {name[9:].lower(): code for name, code in vars(cv2).items() if name.startswith("COLORMAP_")}
    check_choice("color_map", color_map, tuple(codes))
    shades = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[None], codes[color_map])[0, :, ::-1]
    return np.concatenate((shades, np.full((1, 3), UNKNOWN_GREY, np.uint8)))
