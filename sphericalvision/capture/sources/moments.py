# SPDX-License-Identifier: Apache-2.0
"""Moments of a capture: a time and one image of each camera, paired here for image files, videos, streams and bags."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from sphericalvision.core import MissingFileError
from sphericalvision.io.times import SAME_TIME, in_order, nearest_in_time

MAX_UNTIMED = 0.1
"""Fraction of a camera's images without a time of their own, above which a clock tells nothing. A driver that loses a
stamp now and then loses that image; one that never sets it, or sets the same one, must not lose all others."""
WHOLE_SECONDS = 1.5
"""By which times of one moment may differ that cameras write in whole seconds."""

Images = Mapping[str, Mapping[str, Any]]
"""Camera -> name of an image -> what its source reads it by."""
Times = Mapping[str, Mapping[str, float | None]]
"""Camera -> name of an image -> seconds; None where it has none."""


class Clock(NamedTuple):
    """Times of images, from one place in a file.

    Attributes:
        source: where the times stand, for messages: ``"the stamps in their headers"``.
        times: camera -> name of an image -> seconds; None where it has none.
    """

    source: str
    times: Times


class Moments(NamedTuple):
    """Images by moment.

    Attributes:
        frames: name of a moment -> camera -> what its image is read by; called as the first camera's images are.
        times: seconds of each moment; None where images were paired by name or number.
        clock: which of the clocks told the times, counted from 0; None if none did.
        pairing: how images were paired, in a few words; empty for one camera.
        warnings: sentences about clocks that were not used and images that were left out.
    """

    frames: dict[str, dict[str, Any]]
    times: list[float] | None
    clock: int | None
    pairing: str
    warnings: list[str]


def pair_moments(
    images: Images,
    clocks: Sequence[Clock],
    tolerance: float = SAME_TIME,
    key: str = "images",
    names: str = "their names",
) -> Moments:
    """Pair the images of cameras: by the first clock that tells their times, else by their names.

    An image belongs to the image of the first camera that is nearest in time, if it is at most ``tolerance`` away and
    the other way round there is no nearer one either, so that no image is in two moments. What then has no image of
    every camera is left out, and a warning counts it.

    Args:
        images: of each camera; names are equal where images belong together if no clock tells.
        clocks: the best one first.
        tolerance: seconds.
        key: that the images were given by, for messages.
        names: what names are, for messages.

    Raises:
        MissingFileError: there is no moment with an image of every camera.

    Examples:
        >>> images = {"left": {"0": "a", "1": "b"}, "right": {"0": "A", "1": "B"}}  # right began one image later
        >>> clock = Clock("the file", {"left": {"0": 0.0, "1": 0.1}, "right": {"0": 0.1, "1": 0.2}})
        >>> moments = pair_moments(images, [clock])
        >>> moments.frames, moments.times
        ({'1': {'left': 'b', 'right': 'A'}}, [0.1])
    """
    faults: list[str] = []
    for number, clock in enumerate(clocks):
        fault = _fault(clock.times, tolerance, is_last=number == len(clocks) - 1)
        if fault is None:
            moments = _paired_by_time(images, clock, tolerance, key)._replace(clock=number)
            break
        faults.append(f"{clock.source} do not tell when images were taken ({fault})")
    else:
        moments = _paired_by_name(images, key, names)
    if not faults:
        return moments
    source = names if moments.clock is None else clocks[moments.clock].source
    return moments._replace(warnings=[f"{key}: {'; '.join(faults)}: {source} count", *moments.warnings])


def _fault(clock: Times, tolerance: float, is_last: bool) -> str | None:
    """Why times do not tell when images were taken; None if they do."""
    spans: dict[str, tuple[float, float]] = {}
    for camera, times in clock.items():
        values = [time for time in times.values() if time is not None]
        if values:
            spans[camera] = min(values), max(values)
        if len(times) - len(set(values)) <= MAX_UNTIMED * len(times):
            continue
        if len(values) < len(times):
            return f"{len(times) - len(values)} of {len(times)} images of {camera} have no time"
        return f"{len(times)} images of {camera} have {len(set(values))} time(s), the first is {values[0]:g}"
    if is_last or not spans:  # how far apart images are is told where no moment is found
        return None
    latest = max(spans, key=lambda camera: spans[camera][0])
    first = min(spans, key=lambda camera: spans[camera][1])
    wait = spans[latest][0] - spans[first][1]
    return f"{latest} begins {wait:.3g} s after {first} ends" if wait > tolerance else None


def _paired_by_time(images: Images, clock: Clock, tolerance: float, key: str) -> Moments:
    """Moments by times that are there."""
    times = {camera: _timed(clock.times[camera]) for camera in images}
    first, *others = images
    partners: dict[str, dict[str, str]] = {first: {name: name for name in times[first]}}
    # To the nearest image of the camera that has none nearer
    distances = {first: dict.fromkeys(times[first], 0.0)}
    for camera in others:
        forth, back = _nearest(times[first], times[camera]), _nearest(times[camera], times[first])
        partners[camera] = {
            name: candidate
            for name, (candidate, distance) in forth.items()
            if distance <= tolerance and back[candidate][0] == name
        }
        distances[camera] = {candidate: distance for candidate, (_, distance) in back.items()}
        for name, (_, distance) in forth.items():
            distances[first][name] = max(distances[first][name], distance)
    complete = [name for name in times[first] if all(name in own for own in partners.values())]
    matches = {camera: {own[name]: name for name in complete} for camera, own in partners.items()}
    remaining = {
        camera: [name for name in images[camera] if name not in matches[camera]] for camera in images
    }
    gaps = [
        distance
        for camera, names in remaining.items()
        for name in names
        if (distance := distances[camera].get(name, 0.0)) > tolerance
    ]
    reason = "they have no time of their own, or another image is nearer"
    if gaps:
        low, high = f"{min(gaps):.2g}", f"{max(gaps):.2g}"
        span = low if low == high else f"{low} to {high}"
        reason = (
            f"by {clock.source} the nearest of another camera are {span} s away; tolerance is {tolerance:g}"
        )
    if not complete:
        raise MissingFileError(
            f"{key}: no moment has an image of every camera ({_counts(images)}): {reason}. If they are of one moment, "
            "set a larger tolerance="
        )
    frames = {
        name: {camera: images[camera][partners[camera][name]] for camera in images} for name in complete
    }
    spread = max(abs(times[c][own] - times[first][name]) for c in images for own, name in matches[c].items())
    pairing = f"paired by {clock.source}, {1000 * spread:.3g} ms apart at most" if others else ""
    warnings = _left_out(images, remaining, reason, key)
    return Moments(frames, [times[first][name] for name in complete], None, pairing, warnings)


def _timed(times: Mapping[str, float | None]) -> dict[str, float]:
    """Name -> time in the order of times, without images that have none or that of an earlier one."""
    names: dict[float, str] = {}
    for name, time in times.items():
        if time is not None:
            names.setdefault(time, name)
    return {names[time]: time for time in sorted(names)}


def _nearest(times: Mapping[str, float], others: Mapping[str, float]) -> dict[str, tuple[str, float]]:
    """For each image the one of another camera that is nearest in time, and the seconds between them."""
    names = list(others)
    positions = nearest_in_time(list(times.values()), list(others.values()), float("inf"))
    return {
        name: (names[position], abs(others[names[position]] - time))
        for (name, time), position in zip(times.items(), positions, strict=True)
        if position is not None
    }


def _paired_by_name(images: Images, key: str, names: str) -> Moments:
    """Moments of images of equal names."""
    common = set.intersection(*map(set, images.values()))
    if not common:
        examples = ", ".join(min(own) for own in images.values() if own)
        raise MissingFileError(
            f"{key}: no frame has an image of every camera ({_counts(images)}) by {names}, such as {examples}; if more "
            "than a number or a time differs between cameras, name it in the pattern"
        )
    remaining = {camera: in_order(set(own) - common) for camera, own in images.items()}
    frames = {name: {camera: images[camera][name] for camera in images} for name in in_order(common)}
    reason = f"other cameras have none of it by {names}"
    pairing = f"paired by {names}" if len(images) > 1 else ""
    return Moments(frames, None, None, pairing, _left_out(images, remaining, reason, key))


def _counts(images: Images) -> str:
    return ", ".join(f"{camera}: {len(own)}" for camera, own in images.items()) + " images"


def _left_out(images: Images, remaining: Mapping[str, Sequence[str]], reason: str, key: str) -> list[str]:
    """A sentence on the images that are in no moment, if there are any."""
    counts = [
        f"{len(names)} of {len(images[camera])} of {camera} ({names[0]} first)"
        for camera, names in remaining.items()
        if names
    ]
    return [f"{key}: left out are {', '.join(counts)}: {reason}"] if counts else []
