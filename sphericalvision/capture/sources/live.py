# SPDX-License-Identifier: Apache-2.0
"""Frames of live cameras, by OpenCV: a device for each camera, or one with the views of all."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from itertools import count

import cv2

from sphericalvision.cameras import CameraRig
from sphericalvision.capture.sources.frames import Frame, Selection
from sphericalvision.capture.sources.joined_views import size_of_view, split_views
from sphericalvision.core import FileFormatError


class LiveCameras:
    """Frames of live cameras: what they see at the time when it is asked for, without an end.

    Args:
        devices: camera name -> index of a device of this machine; or under the name ``""`` one that has all views.
        rig: of the cameras in use.
        whole: the rig whose views a picture of all holds, of which ``rig`` has some.

    Raises:
        FileFormatError: OpenCV cannot open one of them.
    """

    live = True

    def __init__(self, devices: Mapping[str, int], rig: CameraRig, whole: CameraRig) -> None:
        self.devices, self.rig, self.whole = dict(devices), rig, whole
        self.labels: dict[str, str] = {}
        self.notes: list[str] = []
        self.pairing = "of the moment when they are read" if len(devices) > 1 else ""
        with ExitStack() as stack:
            cameras = self._open(stack)
            self.rate = next(iter(cameras.values())).get(cv2.CAP_PROP_FPS) or 0.0
            height, width = cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_WIDTH
            self._sizes = {name: (int(c.get(height)), int(c.get(width))) for name, c in cameras.items()}

    def _open(self, stack: ExitStack) -> dict[str, cv2.VideoCapture]:
        cameras = {}
        for name, device in self.devices.items():
            cameras[name] = cv2.VideoCapture(device)
            stack.callback(cameras[name].release)
            if not cameras[name].isOpened():
                raise FileFormatError(
                    f"images: OpenCV cannot open camera {device} of this machine; is it connected, and free?"
                )
        return cameras

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Camera name -> (height, width) of its images."""
        if "" not in self._sizes:
            return self._sizes
        return dict.fromkeys(self.rig.names, size_of_view(self._sizes[""], self.whole))

    def names(self, selection: Selection) -> None:
        """None: there is no end."""

    def times(self) -> None:
        """None: nothing tells them."""

    def samples(self) -> list[Frame]:
        """None of them: what is read is gone."""
        return []

    def frames(self, selection: Selection, wanted: Callable[[str], bool]) -> Iterator[Frame]:
        """The selected frames, until a device ends; what is not wanted is not decoded."""
        with ExitStack() as stack:
            cameras = self._open(stack)
            for number in count() if selection.stop is None else range(selection.stop):
                grabbed = [camera.grab() for camera in cameras.values()]  # all of them, at one time
                if not all(grabbed):
                    return
                is_selected = number in range(selection.start, number + 1, selection.every)
                if not is_selected or not wanted(name := f"{number:06d}"):
                    continue
                pictures = {camera: device.retrieve()[1] for camera, device in cameras.items()}
                if lost := [self.devices[camera] for camera, picture in pictures.items() if picture is None]:
                    fault = f"images: camera {lost[0]} of this machine gave no picture {number}"
                    yield Frame(name, None, FileFormatError(fault))
                    continue
                images = {c: cv2.cvtColor(picture, cv2.COLOR_BGR2RGB) for c, picture in pictures.items()}
                if "" in images:
                    views = split_views(images[""], self.whole)
                    images = {camera: views[camera] for camera in self.rig.names}
                yield Frame(name, images)
