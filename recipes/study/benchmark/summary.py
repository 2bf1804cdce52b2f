# SPDX-License-Identifier: Apache-2.0
"""Means over frames with their intervals, and the tables of the benchmark."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from sphericalvision.metrics.spread import Interval, bootstrap_interval

__all__ = ["interval_of", "mean_scores", "values_of"]


def mean_scores(frames: Mapping[str, Any]) -> dict[str, Any]:
    """Means over frames of nested dictionaries of numbers; None counts nowhere, and stays where there is nothing else.

    Examples:
        >>> mean_scores({"a": {"all": {"MAE": 1.0}}, "b": {"all": {"MAE": 3.0}}, "c": {"all": {"MAE": None}}})
        {'all': {'MAE': 2.0}}
    """
    return _mean(list(frames.values()))  # type: ignore[no-any-return]


def _mean(items: list[Any]) -> Any:
    nested = [item for item in items if isinstance(item, Mapping)]
    if nested:
        keys = dict.fromkeys(key for item in nested for key in item)
        return {key: _mean([item.get(key) for item in nested]) for key in keys}
    known = [item for item in items if item is not None]
    return math.fsum(known) / len(known) if known else None


def values_of(frames: Mapping[str, Any], *path: str) -> list[float]:
    """One number of each frame, NaN where there is none."""
    found = []
    for scores in frames.values():
        value: Any = scores
        for key in path:
            value = value.get(key) if isinstance(value, Mapping) else None
        found.append(math.nan if value is None else float(value))
    return found


def interval_of(frames: Mapping[str, Any], *path: str) -> Interval:
    """Mean over frames of one number, and its bootstrap interval of 95 % over scenes."""
    return bootstrap_interval(values_of(frames, *path))
