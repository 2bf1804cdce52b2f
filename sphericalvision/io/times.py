# SPDX-License-Identifier: Apache-2.0
"""Times in names of files and lines of trajectories, and pairs of simultaneous ones."""

from __future__ import annotations

import re
from bisect import bisect_left
from calendar import timegm
from collections.abc import Iterable, Sequence

from sphericalvision.io.files import by_numbers

SAME_TIME = 0.02
"""Largest difference in seconds of what counts as taken at one time."""

_NUMBER = re.compile(r"-?\d+(\.\d*)?(e[+-]?\d+)?", re.IGNORECASE)
_PARTS = re.compile(r"(\d{1,11})_(\d{1,9})")
_UNITS = ((1e12, 4.2e12, 1e-3), (1e15, 4.2e15, 1e-6))
"""From, to and seconds: times since 1970 from 2001 to 2103 in milliseconds and microseconds."""
_NANOSECONDS_FROM = 1e13
"""Larger numbers are nanoseconds, since 1970 or since a device was switched on hours ago."""
SINCE_1970 = 1e9
"""Seconds; no count, resolution or date of a file's name is as large."""
_DATE = re.compile(
    r"((?:19|20)\d\d)-?(0[1-9]|1[0-2])-?(0[1-9]|[12]\d|3[01])[ T_-]?([01]\d|2[0-3])[:-]?([0-5]\d)[:-]?([0-5]\d)"
    r"(?:[.,]?(\d{3})|[.,_](\d{6}|\d{9}))?Z?"
)
"""Year, month, day, hour, minute, second and their fraction; ``_001`` counts the images of a second."""


_UNIT = re.compile(
    r"(?:(?<![A-Za-z])|(?<=[a-z])(?=[A-Z]))([NnUuµ]|[Mm]ic|[Mm])(?:ano|ro|illi)?[sS](?:ec(?:ond)?s?)?(?![A-Za-z])"
    r"|(?i:time(?:code|stamp) format v2)"
)
"""Units of time in the header of a table; the last one, of tables for mkvmerge, means milliseconds."""


def unit_in(header: str) -> float | None:
    """Seconds of the smaller unit that a header names.

    Examples:
        >>> unit_in("timestamp [ns]"), unit_in("time_us"), unit_in("# timecode format v2"), unit_in("time (s)")
        (1e-09, 1e-06, 0.001, None)
    """
    match = _UNIT.search(header)
    return match and {"n": 1e-9, "m": 1e-3}.get((match[1] or "m").lower(), 1e-6)


def seconds(names: Sequence[str], unit: float | None = None) -> list[float | None]:
    """The time in seconds in each name; None for a name without one.

    With ``unit`` names are numbers of it. Else a time is a number, with a sign, decimals or an exponent or without:
    nanoseconds, microseconds, milliseconds or seconds by its magnitude; or two numbers, seconds and their fraction in
    nanoseconds, or in microseconds where no name of all has more than six digits of it and seconds are since 1970. A
    word before the first underscore (``cloud_...``) may stand before times since 1970, in nanoseconds or with decimals:
    ``frame_12`` is a count, ``1920_1080`` a size. Dates (``20240131_235959``, ``2024-01-31 23:59:59``) are times where
    all have fractions of a second (``PXL_20240131_235959123``, ``2024-01-31T23-59-59.123456Z``), too. Decimals of
    unequal lengths up to nine, some of which end in 0, are nanoseconds without the zeros in front: no program writes
    fractions so.

    Examples:
        >>> seconds(["cloud_1700000000_250000000", "1700000000.25", "1700000000250000000", "1.70000000025e+18"])
        [1700000000.25, 1700000000.25, 1700000000.25, 1700000000.25]
        >>> seconds(["1700000000250000", "1700000000250", "left"]), seconds(["1700000000_250000"])
        ([1700000000.25, 1700000000.25, None], [1700000000.25])
        >>> seconds(["12", "frame_12", "frame_12.5", "1920_1080", "20240131_235959"])
        [12.0, None, 12.5, None, None]
    """
    if unit is not None:
        return [unit * float(name) if _NUMBER.fullmatch(name) else None for name in names]
    stems = [re.sub(r"^[A-Za-z]+_(?=\d)", "", name) for name in names]
    dates = [date for stem in stems if (date := _DATE.fullmatch(stem))]
    if len(dates) == len(stems):
        return [_of_date(date) if all(date[7] or date[8] for date in dates) else None for date in dates]
    decimals = [stem.partition(".")[2] for stem in stems]
    is_unpadded = any(re.fullmatch(r"\d+0", text) and len(text) < 9 for text in decimals)
    if is_unpadded and max(map(len, decimals)) == 9:
        stems = [stem.replace(".", "_") for stem in stems]
    matches = [_PARTS.fullmatch(stem) for stem in stems]
    is_nano = any(len(part[2]) > 6 for part in matches if part)
    times = [
        int(part[1]) + int(part[2]) * (1e-9 if is_nano else 1e-6) if part else _of_number(stem)
        for stem, part in zip(stems, matches, strict=True)
    ]
    return [
        time
        if time is None or time >= SINCE_1970 or (is_nano if part else stem == name or "." in stem)
        else None
        for name, stem, part, time in zip(names, stems, matches, times, strict=True)
    ]


def _of_date(date: re.Match[str]) -> float:
    *parts, short, long = date.groups()
    return timegm((*map(int, parts), 0, 0, 0)) + float(f"0.{short or long}")


def _of_number(text: str) -> float | None:
    if not _NUMBER.fullmatch(text):
        return None
    value = float(text)
    unit = next((unit for low, high, unit in _UNITS if low <= value < high), None)
    return value * (unit or (1e-9 if value >= _NANOSECONDS_FROM else 1.0))


def are_counts(names: Sequence[str]) -> bool:
    """Whether names are numbers of images or rows, which are no times.

    Examples:
        >>> are_counts(["000012", "13"]), are_counts(["12.0"]), are_counts(["1700000000250"])
        (True, False, False)
    """
    return all(re.fullmatch(r"\d{1,13}", name) and not 1e12 <= int(name) < 4.2e12 for name in names)


def in_order(names: Iterable[str]) -> list[str]:
    """Names in the order of their times, or, if not all have one, of the numbers in them.

    Examples:
        >>> in_order(["12.8", "12.76"]), in_order(["img10", "img2"])
        (['12.76', '12.8'], ['img2', 'img10'])
    """
    named = sorted(names, key=by_numbers)
    times = dict(zip(named, seconds(named), strict=True))
    return sorted(named, key=lambda name: times[name] or 0.0) if None not in times.values() else named


def nearest_in_time(
    times: Sequence[float | None], others: Sequence[float | None], tolerance: float = SAME_TIME
) -> list[int | None]:
    """For each time the place of the nearest of ``others``; None where that is farther away than ``tolerance``.

    Examples:
        >>> nearest_in_time([0.0, 1.0, None], [0.9, 0.01])
        [1, None, None]
    """
    ordered = sorted((other, place) for place, other in enumerate(others) if other is not None)
    indices: list[int | None] = []
    for time in times:
        if time is None:
            indices.append(None)
            continue
        after = bisect_left(ordered, (time, -1))
        candidates = [(abs(other - time), place) for other, place in ordered[max(after - 1, 0) : after + 1]]
        distance, index = min(candidates, default=(float("inf"), -1))
        indices.append(index if ordered and distance <= tolerance else None)
    return indices
