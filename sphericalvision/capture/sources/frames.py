# SPDX-License-Identifier: Apache-2.0
"""Frames one after the other: what a source of them offers, which are chosen, and those of image files.

Files are found by a pattern such as ``cam{camera}/{frame:05d}.png``.
"""

from __future__ import annotations

import math
import re
import string
import warnings
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.capture.sources.joined_views import size_of_view, split_views
from sphericalvision.core import ArgumentError, FileFormatError, MissingFileError
from sphericalvision.io.images import read_image, read_image_size
from sphericalvision.io.times import SAME_TIME, are_counts, in_order, nearest_in_time, seconds

__all__ = [
    "Files",
    "Frame",
    "Selection",
    "Source",
    "called_as_first",
    "find_capture",
    "find_labels",
    "find_masks",
    "read_frame",
]


class Frame(NamedTuple):
    """One frame: its name, and its images by camera name, or why they cannot be read.

    Attributes:
        name: of the frame.
        images: by camera name; None if they cannot be read.
        error: why not.
        rig: of these images, where every frame has one of its own.
    """

    name: str
    images: Mapping[str, Any] | None
    error: Exception | None = None
    rig: CameraRig | None = None


class Selection(NamedTuple):
    """Which frames of a sequence are taken, by position: from ``start``, up to before ``stop``, every so many."""

    start: int = 0
    stop: int | None = None
    every: int = 1

    def __contains__(self, position: object) -> bool:
        """Whether a position is taken.

        Examples:
            >>> [position for position in range(10) if position in Selection(2, 8, 3)]
            [2, 5]
        """
        return (
            isinstance(position, int)
            and position >= self.start
            and (self.stop is None or position < self.stop)
            and (position - self.start) % self.every == 0
        )

    def positions(self, number: int) -> range:
        """The positions that are taken of so many frames.

        Raises:
            ArgumentError: none is.

        Examples:
            >>> list(Selection(1, None, 2).positions(6))
            [1, 3, 5]
        """
        chosen = range(self.start, number if self.stop is None else min(self.stop, number), self.every)
        if not chosen:
            raise ArgumentError(
                f"start, stop: of {number} frame(s) none is from {self.start} to before {self.stop}"
            )
        return chosen


class Source(Protocol):
    """Where frames come from."""

    live: bool
    rate: float
    rig: CameraRig
    whole: CameraRig
    """All cameras of the calibration, of which ``rig`` has some."""
    labels: dict[str, str]
    """What ``{camera}`` stood for, by camera name, where it was not the name."""

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Camera name -> (height, width) of its images, where known."""
        ...

    def names(self, selection: Selection) -> list[str] | None:
        """Names of the frames chosen; None where nobody knows how many there are."""
        ...

    def times(self) -> list[float] | None:
        """Seconds of each frame since the first, where frames have times that their names do not tell."""
        ...

    def samples(self) -> list[Frame]:
        """Up to three frames of the whole sequence."""
        ...

    def frames(self, selection: Selection, wanted: Callable[[str], bool]) -> Iterator[Frame]:
        """The frames chosen that are wanted, one after the other."""
        ...


class Files:
    """Frames of image files.

    Args:
        files: frame -> camera name -> file; or under the name ``""`` one that has the views of all cameras.
        rig: of the cameras, for the sizes of their images.
        whole: the rig whose views a picture holds, of which ``rig`` has some; ``rig`` when not given.
    """

    live, rate = False, 0.0

    def __init__(
        self, files: Mapping[str, Mapping[str, Any]], rig: CameraRig, whole: CameraRig | None = None
    ) -> None:
        self.files, self.rig, self.whole = dict(files), rig, rig if whole is None else whole
        self.labels: dict[str, str] = {}
        self._sampled: dict[str, Frame] = {}
        self._picture_size: tuple[int, int] | None = None  # of all views

    def times(self) -> None:
        """None: names tell times, if anything does."""

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Camera name -> (height, width) of its first image that can be read; the pixels are not."""
        sizes: dict[str, tuple[int, int]] = {}
        for name in self.rig.names:
            for files in list(self.files.values())[:3]:
                with suppress(FileFormatError, OSError):
                    size = read_image_size(files[name] if name in files else files[""])
                    if name not in files:
                        self._picture_size, size = size, size_of_view(size, self.whole)
                    sizes[name] = size
                    break
        return sizes

    def names(self, selection: Selection) -> list[str]:
        """Names of the frames chosen."""
        everything = list(self.files)
        return [everything[position] for position in selection.positions(len(everything))]

    def samples(self) -> list[Frame]:
        """The first, the middle and the last frame, those of them that can be read; ``frames`` has them then."""
        names = list(self.files)
        chosen = {names[position] for position in (0, len(names) // 2, len(names) - 1)}
        self._sampled |= {name: self._read(name) for name in names if name in chosen - self._sampled.keys()}
        return [
            frame for frame in map(self._sampled.__getitem__, sorted(chosen, key=names.index)) if frame.images
        ]

    def frames(self, selection: Selection, wanted: Callable[[str], bool]) -> Iterator[Frame]:
        """The frames chosen that are wanted; one that cannot be read has an error in place of images."""
        for name in self.names(selection):
            if wanted(name):
                yield self._sampled.pop(name) if name in self._sampled else self._read(name)

    def _read(self, name: str) -> Frame:
        try:
            return Frame(name, self._images(self.files[name]))
        except (FileFormatError, OSError) as error:
            return Frame(name, None, error)

    def _images(self, files: Mapping[str, Any]) -> dict[str, Any]:
        if "" not in files:
            return read_frame(files, self.rig)
        picture = read_image(files[""], what="a picture of all views").movedim(0, -1)
        height, width = self._picture_size = self._picture_size or (picture.shape[0], picture.shape[1])
        if picture.shape[:2] != (height, width):
            raise FileFormatError(
                f"{files['']}: expected {width} x {height} pixels (width x height), as the first picture of all views "
                f"has, got {picture.shape[1]} x {picture.shape[0]}"
            )
        views = split_views(picture, self.whole)
        return {name: views[name].movedim(-1, 0) for name in self.rig.names}


def find_capture(
    pattern: str,
    names: Sequence[str],
    frames: Iterable[int | str] | None = None,
    leave_out: Iterable[Path] = (),
    key: str = "images",
    labels: Mapping[str, str] | None = None,
    tolerance: float = SAME_TIME,
) -> dict[str, dict[str, Path]]:
    """Find the frames that every camera has, or the frames asked for: frame -> camera name -> file, frames in order.

    ``{camera}`` stands for the camera's name in the rig, the number in that name, or its place counted from 0
    or from 1: the first of these for which all cameras have files. ``{frame}`` stands for the frame, with a
    width if given (``{frame:05d}``); it may be missing when there is one frame only.

    Args:
        pattern: of the files.
        names: cameras of the rig, in order.
        frames: frame numbers or names; all that are found when not given.
        leave_out: files that are no images, such as masks that lie beside them.
        key: that the pattern was given by, for messages.
        labels: what ``{camera}`` stands for, as ``find_labels`` has it of the whole rig; by default of ``names``.
        tolerance: seconds between images of one frame, at most, where frames are called by their times and cameras
            differ; such frames are called as the first camera's, and a warning says how far apart images are.

    A frame that some cameras lack is left out with a warning.

    Raises:
        ArgumentError: the pattern has no ``{camera}``, or other fields.
        MissingFileError: no files, or a frame asked for is missing; the message names what was looked for.
    """
    requested = None if frames is None else [_frame_text(pattern, frame) for frame in frames]
    others = {path.resolve() for path in leave_out}
    if labels is None:
        labels = find_labels(pattern, names, leave_out=leave_out, key=key)
    by_camera = {name: _files(pattern, labels[name], others) for name in names}
    counts = ", ".join(f"{name}: {len(files)}" for name, files in by_camera.items())
    times = _times(by_camera)
    by_camera, apart = called_as_first(by_camera, times, tolerance)
    common = set.intersection(*map(set, by_camera.values()))
    lacking = set().union(*by_camera.values()) - common
    if common and apart:
        warnings.warn(
            f"{key}: images of one frame have names that differ, by {1000 * apart:.3g} ms at most; they count as taken "
            f"when {names[0]}'s is, as tolerance={tolerance:g} (seconds) has it",
            stacklevel=2,
        )
    if requested is None:
        chosen = in_order(common)
        if not chosen:
            raise MissingFileError(
                f"{key}: no frame of {pattern!r} is there for every camera ({counts} files)"
                + _distance(by_camera, times, tolerance)
            )
        if lacking:
            warnings.warn(
                f"{key}: {len(lacking)} frame(s) that not every camera has are left out, "
                f"{', '.join(in_order(lacking)[:4])} first ({counts} files)",
                stacklevel=2,
            )
    else:
        chosen = requested
    for frame in chosen:
        for name, files in by_camera.items():
            if frame not in files:
                raise MissingFileError(
                    f"{key}: {_path(pattern, labels[name], frame)}: no such file, frame {frame} of camera {name}; its "
                    f"first frames are {', '.join(in_order(files)[:4])}. Correct frames=... or the pattern."
                )
    return {frame: {name: by_camera[name][frame] for name in names} for frame in chosen}


def _times(files: Mapping[str, Mapping[str, Path]]) -> dict[str, float]:
    """Frame -> seconds of all cameras' frames, where cameras have other frames and all are called by their times."""
    frames = list(set().union(*files.values()))
    if all(len(mine) == len(frames) for mine in files.values()) or are_counts(frames):
        return {}
    return {frame: time for frame, time in zip(frames, seconds(frames), strict=True) if time is not None}


def called_as_first(
    files: Mapping[str, Mapping[str, Any]], times: Mapping[str, float], tolerance: float
) -> tuple[dict[str, dict[str, Any]], float]:
    """Files by the first camera's frames where they are at most ``tolerance`` away, and seconds of the farthest.

    Either is the nearest of the other, so that no image is in two frames.
    """
    frames = [frame for frame in next(iter(files.values())) if frame in times]
    result, apart = {}, 0.0
    for name, mine in files.items():
        others = [frame for frame in mine if frame in times]
        of_frames, of_others = [times[frame] for frame in frames], [times[other] for other in others]
        forth = nearest_in_time(of_others, of_frames, tolerance)
        back = nearest_in_time(of_frames, of_others, tolerance)
        pairs = {
            other: frames[place]
            for number, (other, place) in enumerate(zip(others, forth, strict=True))
            if place is not None and back[place] == number
        }
        apart = max([apart, *(abs(times[other] - times[frame]) for other, frame in pairs.items())])
        result[name] = {pairs.get(frame, frame): file for frame, file in mine.items()}
    return result, apart


def _distance(files: Mapping[str, Mapping[str, Path]], times: Mapping[str, float], tolerance: float) -> str:
    """How far apart in time the nearest images of the first camera and of another one are, in a sentence."""
    first, *others = files
    frames = [frame for frame in files[first] if frame in times]
    nearest = {}
    for name in others:
        mine = [frame for frame in files[name] if frame in times]
        places = nearest_in_time(
            [times[frame] for frame in frames], [times[frame] for frame in mine], math.inf
        )
        pairs = [(f, mine[place]) for f, place in zip(frames, places, strict=True) if place is not None]
        nearest[name] = min((abs(times[frame] - times[other]) for frame, other in pairs), default=0.0)
    name = max(nearest, key=lambda other: nearest[other], default=first)
    farthest = nearest.get(name, 0.0)
    if farthest <= tolerance:
        return ""
    return (
        f". Names are times, and those of {first} and {name} are {1000 * farthest:.3g} ms apart or more; "
        f"tolerance={1.1 * farthest:.2g} (seconds) takes them as one frame, if they are"
    )


def find_labels(
    pattern: str,
    names: Sequence[str],
    cameras: Sequence[str] | None = None,
    leave_out: Iterable[Path] = (),
    key: str = "images",
) -> dict[str, str]:
    """What ``{camera}`` stands for in a pattern: camera name -> label, of all cameras that are used.

    It is decided on the whole rig, so that a camera has the same files whether all cameras are used or some: the first
    way of ``find_capture`` for which all cameras have files; else, as nothing tells for which the others lack them,
    the only one for which those that are used have files.

    Args:
        pattern: of the files.
        names: cameras of the whole rig, in order.
        cameras: those that are used; all when not given.
        leave_out: files that are no images.
        key: that the pattern was given by, for messages.

    Raises:
        ArgumentError: the pattern has no ``{camera}``, or other fields, or ways differ in which file is whose.
        MissingFileError: no way has files of all cameras.
    """
    fields = _fields(pattern)
    used = list(names if cameras is None else cameras)
    if not ("camera" in fields or len(used) == 1) or not fields <= {"camera", "frame"}:
        raise ArgumentError(
            f"{key}: expected a pattern with {{camera}} and, if there are several frames, {{frame}}, such as "
            f"'capture/cam{{camera}}/{{frame:05d}}.png', got {pattern!r}"
        )
    others = {path.resolve() for path in leave_out}
    ways = [dict(zip(names, labels, strict=True)) for labels in _labelings(names)]
    are_there = {label for way in ways for label in way.values() if _files(pattern, label, others)}
    for way in ways:
        if are_there.issuperset(way.values()):
            return {name: way[name] for name in used}
    partly = [way for way in ways if are_there.issuperset(way[name] for name in used)]
    is_named = bool(partly) and partly[0] is ways[0]  # names are explicit
    if not is_named and any(way[name] != partly[0][name] for way in partly for name in used):
        readings = "; or ".join(", ".join(f"{name} is {way[name]}" for name in used) for way in partly)
        raise ArgumentError(
            f"{key}: {pattern!r} has files of some cameras of the rig alone, and {{camera}} may stand for several "
            f"things: {readings}. Call the files as the cameras are, or remove the other cameras from the calibration"
        )
    if not partly:
        ranges = ", ".join(f"{way[names[0]]}..{way[names[-1]]}" for way in ways)
        raise MissingFileError(
            f"{key}: no files of all {len(used)} cameras match {pattern!r} (looked in {Path.cwd()}). {{camera}} was "
            f"tried as {ranges}; the pattern must reach a file for each camera of the rig: {', '.join(used)}."
        )
    return {name: partly[0][name] for name in used}


def find_masks(pattern: str, names: Sequence[str], cameras: Sequence[str] | None = None) -> dict[str, Path]:
    """Find one mask for each camera by a pattern with ``{camera}``; cameras are named as in ``find_labels``."""
    if _fields(pattern) != {"camera"}:
        raise ArgumentError(
            f"masks: expected a pattern with {{camera}} only, such as 'capture/cam{{camera}}/mask.png', got {pattern!r}"
        )
    labels = find_labels(pattern, names, cameras, key="masks")
    (files,) = find_capture(pattern, list(labels), key="masks", labels=labels).values()
    return files


def read_frame(files: Mapping[str, Path], rig: CameraRig) -> dict[str, Tensor]:
    """Read one frame: camera name -> float32 ``(3, h, w)`` in [0, 1], of the calibration's size."""
    return {
        name: read_image(path, rig.cameras[name].image_size, f"the image of camera {name}")
        for name, path in files.items()
    }


def _fields(pattern: str) -> set[str]:
    try:
        return {field for _, field, _, _ in string.Formatter().parse(pattern) if field is not None}
    except ValueError as error:
        raise ArgumentError(f"images: {pattern!r} is not a pattern ({error})") from None


def _labelings(names: Sequence[str]) -> list[list[str]]:
    """What ``{camera}`` may stand for, camera by camera, most explicit first; never one thing for two cameras."""
    numbers = [re.findall(r"\d+", name) for name in names]
    ways = [list(names)]
    if all(numbers):
        ways.append([digits[-1] for digits in numbers])
    ways.append([str(i) for i in range(len(names))])
    ways.append([str(i + 1) for i in range(len(names))])
    return [way for i, way in enumerate(ways) if way not in ways[:i] and len(set(way)) == len(way)]


def _files(pattern: str, label: str, others: Container[Path] = ()) -> dict[str, Path]:
    """Frame -> file of one camera; ``""`` is the frame of a pattern without ``{frame}``."""
    glob, expression = "", ""
    first = True
    for text, field, spec, _ in string.Formatter().parse(str(Path(pattern).expanduser())):
        glob += re.sub(r"([*?\[])", r"[\1]", text)
        expression += re.escape(text)
        if field == "camera":
            glob += re.sub(r"([*?\[])", r"[\1]", label)
            expression += re.escape(label)
        elif field == "frame":
            digits = spec is not None and spec.endswith("d")
            glob += "*"
            expression += ("(?P<frame>" + (r"\d+" if digits else "[^/]+") + ")") if first else "(?P=frame)"
            first = False
    path = Path(glob)
    anchor = Path(path.anchor) if path.is_absolute() else Path()
    files = {}
    for file in anchor.glob(str(path.relative_to(path.anchor) if path.is_absolute() else path)):
        match = re.fullmatch(expression, str(file))
        is_hidden = file.name.startswith(".") and not Path(pattern).name.startswith(
            "."
        )  # ._0001.png of macOS
        if match and not is_hidden and file.is_file() and file.resolve() not in others:
            frame = match.groupdict().get("frame") or ""
            if re.search(
                "[\0-\x1f\ud800-\udfff]", frame
            ):  # results are listed by name, a line each, in UTF-8
                raise ArgumentError(
                    f"images: {str(file)!a}: expected a name in UTF-8 without line ends; rename it"
                )
            files[frame] = file
    return files


def _frame_text(pattern: str, frame: int | str) -> str:
    """A frame as it stands in file names."""
    for _, field, spec, _ in string.Formatter().parse(pattern):
        if field == "frame":
            try:
                return format(int(frame) if spec and spec.endswith("d") else frame, spec or "")
            except ValueError:
                raise ArgumentError(f"frames: expected numbers, as {pattern!r} says, got {frame!r}") from None
    raise ArgumentError(f"frames: {pattern!r} has no {{frame}} to put {frame!r} in")


def _path(pattern: str, label: str, frame: str) -> str:
    values = {"camera": label, "frame": frame, None: ""}
    return "".join(text + values[field] for text, field, _, _ in string.Formatter().parse(pattern))
