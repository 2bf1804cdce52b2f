# SPDX-License-Identifier: Apache-2.0
"""Frames of one camera that moves: each is a window of its images, which are a rig."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch

from sphericalvision.cameras import CameraRig, Trajectory
from sphericalvision.capture.sources.frames import Frame, Selection, Source
from sphericalvision.core import ArgumentError

__all__ = ["NAME", "Moving"]

NAME = "camera"
"""Of the one camera, where a source of its images asks for one."""
STILL = 1e-6
"""Metres between images that are in one place."""


class Moving:
    """Windows of the images of one camera.

    Args:
        source: of its images.
        poses: of these images.
        size: images in a window.
        spacing: metres between them.
        mask: ``(h, w)``, True where images are usable.

    Attributes:
        rig: the window with the middle of all radii.

    Raises:
        ArgumentError: there is no window, or nothing tells which pose is whose.
    """

    live = False

    def __init__(
        self, source: Source, poses: Trajectory, size: int, spacing: float, mask: torch.Tensor | None = None
    ) -> None:
        names = source.names(Selection())
        if names is None:
            raise ArgumentError(
                "poses: of images that come live, or whose number nobody knows, poses cannot be told"
            )
        times = [number / source.rate for number in range(len(names))] if source.rate else None
        poses = poses.of_images(names, times)
        windows = poses.windows(size, spacing)
        (camera,) = source.rig.cameras.values()
        self.source, self.rate, self.unposed = source, source.rate, len(names) - len(poses)
        self.rigs = {}
        self._sampled: dict[str, Frame] = {}
        for window in windows:
            self.rigs[poses.names[window[size // 2]]] = poses.rig(camera, window, mask)
        self.rig = sorted(self.rigs.values(), key=lambda rig: float(rig.radius))[len(self.rigs) // 2]

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Of the rig that all windows have in common: as calibrated."""
        return {name: camera.image_size for name, camera in self.rig.cameras.items()}

    def names(self, selection: Selection) -> list[str]:
        """Names of the windows chosen: those of their images in the middle."""
        everything = list(self.rigs)
        return [everything[position] for position in selection.positions(len(everything))]

    def samples(self) -> list[Frame]:
        """The first, the middle and the last window."""
        last = len(self.rigs) - 1
        windows = {
            name: self.rigs[name] for name in (list(self.rigs)[number] for number in (0, last // 2, last))
        }
        if not self._sampled:
            needed = {image for rig in windows.values() for image in rig.names}
            self._sampled = {f.name: f for f in self.source.frames(Selection(), needed.__contains__)}
        found = (self._window(name, rig, self._sampled) for name, rig in windows.items())
        return [frame for frame in found if frame.images is not None]

    def frames(self, selection: Selection, wanted: Callable[[str], bool]) -> Iterator[Frame]:
        """The windows chosen that are wanted, each as soon as its last image is there; an image is read once."""
        waiting = [(name, self.rigs[name]) for name in self.names(selection) if wanted(name)]
        last = {image: number for number, (_, rig) in enumerate(waiting) for image in rig.names}
        read = {image: frame for image, frame in self._sampled.items() if image in last}
        others = self.source.frames(Selection(), lambda image: image in last and image not in self._sampled)
        for number, (name, rig) in enumerate(waiting):
            while not all(image in read for image in rig.names):
                image = next(others)
                read[image.name] = image
            yield self._window(name, rig, read)
            read = {image: frame for image, frame in read.items() if last[image] > number}

    def _window(self, name: str, rig: CameraRig, read: dict[str, Frame]) -> Frame:
        images: dict[str, Any] = {}
        for image in rig.names:
            frame = read[image]
            if frame.images is None:
                return Frame(name, None, frame.error)
            images[image] = frame.images[NAME]
        if float(rig.radius) < STILL:
            error = ArgumentError(
                f"poses: {', '.join(rig.names)} are in one place; spacing= passes such over"
            )
            return Frame(name, None, error)
        return Frame(name, images, rig=rig)
