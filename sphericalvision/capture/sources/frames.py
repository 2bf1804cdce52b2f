# SPDX-License-Identifier: Apache-2.0
"""Frames one after the other: what every source of them offers, and what recordings have in common."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any, NamedTuple, Protocol

from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.capture.sources.joined_views import split_views
from sphericalvision.capture.sources.moments import Moments
from sphericalvision.core import ArgumentError, FileFormatError


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
    """The frames of a sequence that are used, by position: from ``start``, up to before ``stop``, every so many."""

    start: int = 0
    stop: int | None = None
    every: int = 1

    def positions(self, count: int) -> range:
        """The selected positions of so many frames.

        Examples:
            >>> list(Selection(1, None, 2).positions(6))
            [1, 3, 5]
        """
        positions = range(self.start, count if self.stop is None else min(self.stop, count), self.every)
        if not positions:
            stop = "" if self.stop is None else f", stop={self.stop}"
            raise ArgumentError(
                f"start={self.start}{stop}: the capture has {count} frame(s), 0 to {count - 1}"
            )
        return positions


class Source(Protocol):
    """Where frames come from."""

    live: bool
    rate: float
    rig: CameraRig
    whole: CameraRig
    """All cameras of the calibration, of which ``rig`` has some."""
    labels: dict[str, str]
    """The label of each camera's files, streams or topics, by camera name, where it is not the name."""
    pairing: str
    """How images of one moment were paired, in a few words; empty where there was nothing to pair."""
    notes: list[str]
    """Sentences about images that are left out, which are warnings when the source is opened."""

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Camera name -> (height, width) of its images, where known."""
        ...

    def names(self, selection: Selection) -> list[str] | None:
        """Names of the selected frames; None of live cameras."""
        ...

    def times(self) -> list[float] | None:
        """Seconds of each frame, where frames have times that their names do not tell."""
        ...

    def samples(self) -> list[Frame]:
        """Up to three frames of the whole sequence."""
        ...

    def frames(self, selection: Selection, wanted: Callable[[str], bool]) -> Iterator[Frame]:
        """The selected frames that are wanted, one after the other."""
        ...


class Recording:
    """Frames that can be read again and in any order. A subclass says how an image is read.

    Args:
        moments: of images that are not read yet; a camera named ``""`` has pictures with the views of all.
        rig: of the cameras in use.
        whole: the rig whose views such pictures hold; ``rig`` when not given.
    """

    live, rate = False, 0.0

    def __init__(self, moments: Moments, rig: CameraRig, whole: CameraRig | None = None) -> None:
        self.moments, self.rig, self.whole = moments.frames, rig, rig if whole is None else whole
        self.labels: dict[str, str] = {}
        self.pairing = moments.pairing
        self.notes = list(moments.warnings)
        for sentence in self.notes:
            warnings.warn(sentence, stacklevel=4)
        self._samples: dict[str, Frame] = {}

    def opened(self) -> AbstractContextManager[Callable[[str, Any], Any]]:
        """Open what images are read from: gives a function of a camera and what an image of it is read by."""
        raise NotImplementedError

    def times(self) -> list[float] | None:
        """None: names tell times, if anything does."""
        return None

    def names(self, selection: Selection) -> list[str]:
        """Names of the selected frames."""
        names = list(self.moments)
        return [names[position] for position in selection.positions(len(names))]

    def samples(self) -> list[Frame]:
        """The first, the middle and the last frame, those of them that can be read; ``frames`` has them then."""
        everything = list(self.moments)
        names = [everything[position] for position in sorted({0, len(everything) // 2, len(everything) - 1})]
        if unread := [name for name in names if name not in self._samples]:
            with self.opened() as read:
                self._samples |= {name: self._frame(name, read) for name in unread}
        return [self._samples[name] for name in names if self._samples[name].images is not None]

    def frames(self, selection: Selection, wanted: Callable[[str], bool]) -> Iterator[Frame]:
        """The selected frames that are wanted; one that cannot be read has an error in place of images."""
        with self.opened() as read:
            for name in self.names(selection):
                if wanted(name):
                    yield self._samples.pop(name) if name in self._samples else self._frame(name, read)

    def _frame(self, name: str, read: Callable[[str, Any], Any]) -> Frame:
        try:
            images = {camera: read(camera, handle) for camera, handle in self.moments[name].items()}
        except (FileFormatError, OSError) as error:
            return Frame(name, None, error)
        return Frame(name, self._split(images[""]) if "" in images else images)

    def _split(self, picture: Any) -> dict[str, Any]:
        """The views in a picture of all, a tensor ``(c, h, w)`` or an array ``(h, w, c)``."""
        is_tensor = isinstance(picture, Tensor)
        views = split_views(picture.movedim(0, -1) if is_tensor else picture, self.whole)
        return {name: views[name].movedim(-1, 0) if is_tensor else views[name] for name in self.rig.names}


def spread_evenly(names: Sequence[str], count: int) -> list[str]:
    """So many names, from the first to the last.

    Examples:
        >>> spread_evenly("abcdefg", 3)
        ['a', 'd', 'g']
        >>> spread_evenly("ab", 5), spread_evenly("abc", 1)
        (['a', 'b'], ['a'])
    """
    if len(names) <= count:
        return list(names)
    return [names[round(step * (len(names) - 1) / max(count - 1, 1))] for step in range(count)]
