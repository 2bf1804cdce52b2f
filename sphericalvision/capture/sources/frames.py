# SPDX-License-Identifier: Apache-2.0
"""Frames one after the other: what a source of them offers, which are chosen, and those of image files.

Files are found by a pattern such as ``cam{camera}/{frame:05d}.png``.
"""

from __future__ import annotations

import re
import string
import warnings
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError, FileFormatError, MissingFileError
from sphericalvision.io.images import read_image, read_image_size

__all__ = ["Files", "Frame", "Selection", "Source", "find_capture", "find_masks", "read_frame"]


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

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Camera name -> (height, width) of its images, where known."""
        ...

    def names(self, selection: Selection) -> list[str] | None:
        """Names of the frames chosen; None where nobody knows how many there are."""
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
        files: frame -> camera name -> file.
        rig: of the cameras, for the sizes of their images.
    """

    live, rate = False, 0.0

    def __init__(self, files: Mapping[str, Mapping[str, Path]], rig: CameraRig) -> None:
        self.files, self.rig = dict(files), rig
        self._sampled: dict[str, Frame] = {}

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Camera name -> (height, width) of its first image that can be read; the pixels are not."""
        found: dict[str, tuple[int, int]] = {}
        for name in self.rig.names:
            for files in list(self.files.values())[:3]:
                with suppress(FileFormatError, OSError):
                    found[name] = read_image_size(files[name])
                    break
        return found

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
            return Frame(name, read_frame(self.files[name], self.rig))
        except (FileFormatError, OSError) as error:
            return Frame(name, None, error)


def find_capture(
    pattern: str,
    names: Sequence[str],
    frames: Iterable[int | str] | None = None,
    leave_out: Iterable[Path] = (),
    key: str = "images",
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

    A frame that some cameras lack is left out with a warning.

    Raises:
        ArgumentError: the pattern has no ``{camera}``, or other fields.
        MissingFileError: no files, or a frame asked for is missing; the message names what was looked for.
    """
    fields = _fields(pattern)
    named = "camera" in fields or len(names) == 1
    if not named or not fields <= {"camera", "frame"}:
        raise ArgumentError(
            f"{key}: expected a pattern with {{camera}} and, if there are several frames, {{frame}}, such as "
            f"'capture/cam{{camera}}/{{frame:05d}}.png', got {pattern!r}"
        )
    wanted = None if frames is None else [_frame_text(pattern, frame) for frame in frames]
    others = {path.resolve() for path in leave_out}
    for labels in _labelings(names):
        found = {name: _files(pattern, label, others) for name, label in zip(names, labels, strict=True)}
        if all(found.values()):
            break
    else:
        tried = ", ".join(f"{labels[0]}..{labels[-1]}" for labels in _labelings(names))
        raise MissingFileError(
            f"{key}: no files of all {len(names)} cameras match {pattern!r} (looked in {Path.cwd()}). {{camera}} was "
            f"tried as {tried}; the pattern must reach a file for each camera of the rig: {', '.join(names)}."
        )
    common = set.intersection(*(set(files) for files in found.values()))
    if wanted is None:
        chosen = sorted(common, key=_natural)
        counts = ", ".join(f"{name}: {len(files)}" for name, files in found.items())
        if not chosen:
            raise MissingFileError(
                f"{key}: no frame of {pattern!r} is there for every camera ({counts} files)"
            )
        if lacking := sorted(set().union(*found.values()) - common, key=_natural):
            warnings.warn(
                f"{key}: {len(lacking)} frame(s) that not every camera has are left out, {', '.join(lacking[:4])} "
                f"first ({counts} files)",
                stacklevel=2,
            )
    else:
        chosen = wanted
    for frame in chosen:
        for (name, files), label in zip(found.items(), labels, strict=True):
            if frame not in files:
                raise MissingFileError(
                    f"{key}: {_path(pattern, label, frame)}: no such file, frame {frame} of camera {name}; its first "
                    f"frames are {', '.join(sorted(files, key=_natural)[:4])}. Correct frames=... or the pattern."
                )
    return {frame: {name: found[name][frame] for name in names} for frame in chosen}


def find_masks(pattern: str, names: Sequence[str]) -> dict[str, Path]:
    """Find one mask for each camera by a pattern with ``{camera}``; cameras are named as in ``find_capture``."""
    if _fields(pattern) != {"camera"}:
        raise ArgumentError(
            f"masks: expected a pattern with {{camera}} only, such as 'capture/cam{{camera}}/mask.png', got {pattern!r}"
        )
    (files,) = find_capture(pattern, names, key="masks").values()
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
    """What ``{camera}`` may stand for, camera by camera, most explicit first."""
    numbers = [re.findall(r"\d+", name) for name in names]
    ways = [list(names)]
    if all(numbers):
        ways.append([found[-1] for found in numbers])
    ways.append([str(i) for i in range(len(names))])
    ways.append([str(i + 1) for i in range(len(names))])
    return [way for i, way in enumerate(ways) if way not in ways[:i]]


def _files(pattern: str, label: str, others: Container[Path] = ()) -> dict[str, Path]:
    """Frame -> file of one camera; ``""`` is the frame of a pattern without ``{frame}``."""
    glob, expression = "", ""
    first = True
    for text, field, spec, _ in string.Formatter().parse(str(Path(pattern).expanduser())):
        glob += re.sub(r"([*?\[])", r"[\1]", text)
        expression += re.escape(text)
        if field == "camera":
            glob += label
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
        if match and file.is_file() and file.resolve() not in others:
            files[match.groupdict().get("frame") or ""] = file
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


def _natural(text: str) -> list[tuple[int, str]]:
    """Sorting key that puts frame 9 before frame 10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", text)]
