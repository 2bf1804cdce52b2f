# SPDX-License-Identifier: Apache-2.0
"""Frames one after the other, from image files: what a source of frames offers, and which of them are chosen."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from sphericalvision.cameras import CameraRig
from sphericalvision.capture.sources.captures import read_frame
from sphericalvision.core import ArgumentError, FileFormatError
from sphericalvision.io.images import read_image_size

__all__ = ["Files", "Frame", "Selection", "Source"]


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
