# SPDX-License-Identifier: Apache-2.0
"""Frames of one camera that moves: each is a window of its images, which are a rig."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch

from sphericalvision.cameras import CameraRig, EquirectangularCamera, Trajectory, read_camera, read_trajectory
from sphericalvision.capture.sources.frames import Frame, Selection, Source
from sphericalvision.core import ArgumentError
from sphericalvision.io.images import read_image
from sphericalvision.recipes.app.rigs import keys_named, radians
from sphericalvision.recipes.prediction.sources import open_source, rig_for_images

__all__ = ["NAME", "PANORAMA", "Moving", "open_moving"]

NAME = "camera"
"""Of the one camera, where a source of its images asks for one."""
PANORAMA = "equirectangular"
"""In place of a calibration file: images are whole panoramas of any size."""
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
        with keys_named(images="poses"):
            poses = poses.of_images(names, times)
            windows = poses.windows(size, spacing)
        (camera,) = source.rig.cameras.values()
        self.source, self.rate, self.unposed = source, source.rate, len(names) - len(poses)
        self.rigs = {}
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
        wanted = {list(self.rigs)[number] for number in (0, last // 2, last)}
        return [frame for frame in self.frames(Selection(), wanted.__contains__) if frame.images is not None]

    def frames(self, selection: Selection, wanted: Callable[[str], bool]) -> Iterator[Frame]:
        """The windows chosen that are wanted, each as soon as its last image is there; an image is read once."""
        waiting = [(name, self.rigs[name]) for name in self.names(selection) if wanted(name)]
        needed = {image for _, rig in waiting for image in rig.names}
        read: dict[str, Frame] = {}
        for image in self.source.frames(Selection(), needed.__contains__):
            read[image.name] = image
            while waiting and waiting[0][1].names[-1] in read:
                name, rig = waiting.pop(0)
                yield self._window(name, rig, read)
                kept = set(waiting[0][1].names) if waiting else set()
                read = {key: frame for key, frame in read.items() if key in kept}

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


def open_moving(
    calibration: str,
    images: str,
    poses: str,
    *,
    window: int = 3,
    spacing: float | None = None,
    up: str = "-y",
    mask: str | None = None,
    frames: list[int | str] | None = None,
    max_angle_deg: float | None = None,
) -> Moving:
    """Find the images of one camera, and their poses.

    Args:
        calibration: file of the camera, or ``PANORAMA``.
        images: as of ``open_source``, of one camera.
        poses: file of them.
        window: images in a window.
        spacing: metres between them; all images when not given.
        up: of the poses' world.
        mask: image, white where usable.
        frames: names or numbers of the images to take.
        max_angle_deg: half the field of view in degrees.
    """
    trajectory = read_trajectory(poses).turned(up)
    if calibration == PANORAMA:
        camera: Any = EquirectangularCamera((512, 1024))
    else:
        with keys_named(path="calibration", name="calibration", max_angle="max_angle_deg"):
            camera = read_camera(calibration, max_angle=radians(max_angle_deg))
    single = CameraRig({NAME: camera}, torch.eye(4)[None])
    source = open_source(images, single, frames, () if mask is None else [Path(mask)])
    source.rig = rig_for_images(single, source.sizes())
    shown = source.rig.cameras[NAME]
    usable = None if mask is None else read_image(mask, shown.image_size, "the mask")[0] > 0.5
    return Moving(source, trajectory, window, spacing or 0.0, usable)
