# SPDX-License-Identifier: Apache-2.0
"""The part of the sphere that a panorama shows."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.core import ArgumentError, short_repr

ALL_LATITUDES = (-math.pi / 2, math.pi / 2)
ALL_LONGITUDES = (-math.pi, math.pi)
_ROUNDING = 1e-6  # of files that hold single precision


def checked_limits(
    latitudes: Sequence[float], longitudes: Sequence[float]
) -> tuple[tuple[float, float], tuple[float, float]]:
    """(bottom, top) and (left, right) in radians, as floats; what is whole up to rounding is whole.

    Raises:
        ArgumentError: they are not two rising numbers, within ±π/2 or no more than 2π apart.

    Examples:
        >>> checked_limits((-0.5, 1.0), (0, 1.5))
        ((-0.5, 1.0), (0.0, 1.5))
    """
    try:
        bottom, top, left, right = (float(value) for pair in (latitudes, longitudes) for value in pair)
    except (TypeError, ValueError):
        raise ArgumentError(
            "latitudes, longitudes: expected two numbers each, in radians, got "
            f"{short_repr(latitudes)} and {short_repr(longitudes)}"
        ) from None
    bottom, top, left = _snapped(bottom, -math.pi / 2), _snapped(top, math.pi / 2), _snapped(left, -math.pi)
    if not -math.pi / 2 <= bottom < top <= math.pi / 2:
        raise ArgumentError(f"latitudes: expected (lower, upper) in radians, within ±π/2, got {latitudes}")
    width_angle = _snapped(right - left, 2 * math.pi)
    if not 0 < width_angle <= 2 * math.pi:
        raise ArgumentError(
            f"longitudes: expected (left, right) in radians, at most 2π apart, got {longitudes}"
        )
    return (bottom, top), (left, left + width_angle)


def goes_around(longitudes: tuple[float, float]) -> bool:
    """Whether the left and the right edge of a panorama meet.

    Examples:
        >>> goes_around((-math.pi, math.pi)), goes_around((-1.0, 1.0))
        (True, False)
    """
    return longitudes[1] - longitudes[0] > 2 * math.pi - _ROUNDING


def limits_in_words(latitudes: tuple[float, float], longitudes: tuple[float, float]) -> str:
    """What follows the size in the name of a panorama; nothing for the whole sphere.

    Examples:
        >>> limits_in_words((-math.pi / 4, math.pi / 4), (0, math.pi))
        ', latitudes within 45.0°, longitudes 0.0° to 180.0°'
    """
    rows = []
    for name, limits, whole in (
        ("latitudes", latitudes, ALL_LATITUDES),
        ("longitudes", longitudes, ALL_LONGITUDES),
    ):
        low, high = map(math.degrees, limits)
        if limits != whole:
            rows.append(
                f", {name} " + (f"within {high:.1f}°" if low == -high else f"{low:.1f}° to {high:.1f}°")
            )
    return "".join(rows)


def longitude_within(
    longitude: Float[Tensor, "*batch"], longitudes: tuple[float, float]
) -> Float[Tensor, "*batch"]:
    """Longitudes (*) in ±π, each by the turn more or less that brings it within half a turn of the limits' middle.

    Examples:
        >>> longitude_within(torch.tensor([-3.0, 3.0]), (2.0, 4.0))
        tensor([3.2832, 3.0000])
    """
    center = (longitudes[0] + longitudes[1]) / 2
    if center == 0:
        return longitude
    revolutions = torch.round((center - longitude.detach()) / (2 * math.pi))
    return longitude + revolutions * (2 * math.pi)


def _snapped(value: float, whole: float) -> float:
    return whole if abs(value - whole) <= _ROUNDING else value
