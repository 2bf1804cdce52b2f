# SPDX-License-Identifier: Apache-2.0
"""Frames of a camera or a rig that moves: each is a window of its images, which are a rig."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from sphericalvision.cameras import CameraRig, Trajectory
from sphericalvision.capture.sources.frames import Frame, Selection, Source
from sphericalvision.core import ArgumentError

NAME = "camera"
"""Of the one camera, where a source of its images asks for one."""
STILL = 1e-6
"""Metres between images that are in one place."""


class Moving:
    """Windows of the images of one camera, or of a rig's frames.

    Args:
        source: of the images; masks and poses of its cameras count, and a change of its rig is one of all windows.
        poses: of these images, or of the rig at these frames.
        size: images or frames in a window.
        spacing: metres between them.

    Raises:
        ArgumentError: there is no window, or nothing tells which pose is whose.
    """

    live = False

    def __init__(self, source: Source, poses: Trajectory, size: int, spacing: float) -> None:
        names = source.names(Selection())
        if names is None:
            raise ArgumentError(
                "poses: needs recorded images; live cameras and streams of unknown length have no poses"
            )
        times = source.times()
        if times is not None:  # a video may end before its header says
            names, times = names[: len(times)], times[: len(names)]
        matches = poses.matches(names, times)
        self.poses = poses.of_images(names, times)
        self.first_pair = next((image, poses.names[place]) for image, place in matches.items())
        if len(self.poses) < size:
            raise ArgumentError(
                f"window: expected {size} frames with poses or more, got {len(self.poses)} of {len(names)}"
            )
        self.source, self.rate, self.unposed = source, source.rate, len(names) - len(self.poses)
        windows = self.poses.windows(size, spacing)
        self.windows = {self.poses.names[window[size // 2]]: window for window in windows}
        self.labels, self.pairing, self.notes = source.labels, source.pairing, source.notes
        self._sampled: dict[str, Frame] = {}

    @property
    def rig(self) -> CameraRig:
        """The window with the middle of all lengths."""

        def length(window: list[int]) -> float:
            positions = self.poses.positions[window]
            return float((positions - positions.mean(0)).norm(dim=-1).mean())

        return self._rig(sorted(self.windows.values(), key=length)[len(self.windows) // 2])

    def _rig(self, window: list[int]) -> CameraRig:
        return self.poses.rig(self.source.rig, window)

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Of the rig that all windows have in common: as calibrated."""
        return {name: camera.image_size for name, camera in self.rig.cameras.items()}

    def times(self) -> None:
        """None: windows are called as their images."""

    def names(self, selection: Selection) -> list[str]:
        """Names of the windows chosen: those of their images in the middle."""
        everything = list(self.windows)
        return [everything[position] for position in selection.positions(len(everything))]

    def samples(self) -> list[Frame]:
        """The first, the middle and the last window."""
        names = list(self.windows)
        windows = {name: self.windows[name] for name in (names[0], names[(len(names) - 1) // 2], names[-1])}
        if not self._sampled:
            needed = {self.poses.names[number] for window in windows.values() for number in window}
            self._sampled = {f.name: f for f in self.source.frames(Selection(), needed.__contains__)}
        frames = (self._window(name, self._sampled) for name in windows)
        return [frame for frame in frames if frame.images is not None]

    def frames(self, selection: Selection, wanted: Callable[[str], bool]) -> Iterator[Frame]:
        """The windows chosen that are wanted, each as soon as its last image is there; an image is read once."""
        waiting = [name for name in self.names(selection) if wanted(name)]
        last = {image: number for number, name in enumerate(waiting) for image in self._images(name)}
        read = {image: frame for image, frame in self._sampled.items() if image in last}
        others = self.source.frames(Selection(), lambda image: image in last and image not in self._sampled)
        for number, name in enumerate(waiting):
            while not all(image in read for image in self._images(name)):
                image = next(others)
                read[image.name] = image
            yield self._window(name, read)
            read = {image: frame for image, frame in read.items() if last[image] > number}

    def _images(self, name: str) -> list[str]:
        return [self.poses.names[number] for number in self.windows[name]]

    def _window(self, name: str, read: dict[str, Frame]) -> Frame:
        rig = self._rig(self.windows[name])
        images: list[Any] = []
        for image in self._images(name):
            frame = read[image]
            if frame.images is None:
                return Frame(name, None, frame.error)
            images += (frame.images[camera] for camera in self.source.rig.names)
        if float(rig.radius) < STILL:
            fault = f"poses: {', '.join(rig.names)} are in one place; spacing= passes such over"
            return Frame(name, None, ArgumentError(fault))
        return Frame(name, dict(zip(rig.names, images, strict=True)), rig=rig)
