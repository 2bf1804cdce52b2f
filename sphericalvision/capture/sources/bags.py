# SPDX-License-Identifier: Apache-2.0
"""Frames of a ROS bag, of ROS 1 or 2, by the package rosbags: a topic of images, raw or compressed, for each camera."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from sphericalvision.cameras import CameraRig
from sphericalvision.capture.sources.frames import Files, called_as_first
from sphericalvision.core import ArgumentError, FileFormatError, MissingFileError
from sphericalvision.io.files import by_numbers
from sphericalvision.io.times import SAME_TIME

__all__ = ["Bag", "bag_of"]

SUFFIXES = (".bag", ".mcap", ".db3")
KINDS = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
CHANNELS = {"mono8": 1, "rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4}
"""Of pictures of bytes; what a sensor with a mosaic of colours saw is made a picture, too."""


def bag_of(path: Path) -> Path | None:
    """The bag that a path names, as rosbags takes it: a folder with ``metadata.yaml``, else a file; None without one.

    Raises:
        MissingFileError: no such file.
        ArgumentError: rosbags is not installed.
    """
    suffix, is_folder = path.suffix.lower(), (path / "metadata.yaml").is_file()
    if suffix not in SUFFIXES and not is_folder:
        return None
    if not is_folder and not path.is_file():
        raise MissingFileError(
            f"images: {path}: expected a bag of ROS 1 or 2, a file or a folder with metadata.yaml"
        )
    if find_spec("rosbags") is None:
        raise ArgumentError(
            f"images: {path} is a bag, which rosbags reads: pip install 'sphericalvision[bags]'"
        )
    is_part = suffix != ".bag" and not is_folder and (path.parent / "metadata.yaml").is_file()
    return path.parent if is_part else path


class Bag(Files):
    """Frames of a bag; they are called by the first camera's time stamps, in nanoseconds.

    A camera's topic is the one with its name between slashes, ``/front/image_raw``; where not every camera has one,
    and there are as many topics as cameras, they belong together in their order.

    Args:
        path: as ``bag_of`` has it.
        rig: of the cameras that are used.
        whole: the rig that decides which topic is whose.
        tolerance: seconds between images of one frame, at most.

    Raises:
        ArgumentError: topics are not those of the cameras.
        FileFormatError: the bag cannot be read.
        MissingFileError: no moment has an image of every camera.
    """

    def __init__(self, path: Path, rig: CameraRig, whole: CameraRig, tolerance: float = SAME_TIME) -> None:
        super().__init__({}, rig, whole)
        self.path = path
        with self._reader() as reader:
            topics = _topics(reader.connections, whole.names, path)
            self.topics = {name: topics[name] for name in rig.names}
            if any(name not in topic.split("/") for name, topic in topics.items()):
                self.labels = dict(self.topics)
            by_topic = {topic: name for name, topic in self.topics.items()}
            used = [connection for connection in reader.connections if connection.topic in by_topic]
            stamps: dict[str, dict[str, Any]] = {name: {} for name in rig.names}
            for connection, time, data in reader.messages(connections=used):
                stamp = reader.deserialize(data, connection.msgtype).header.stamp
                nanoseconds = 10**9 * stamp.sec + stamp.nanosec
                stamps[by_topic[connection.topic]][str(nanoseconds)] = time
        times = {stamp: int(stamp) / 1e9 for mine in stamps.values() for stamp in mine}
        matched, _ = called_as_first(stamps, times, tolerance)
        common = set.intersection(*map(set, matched.values()))
        if not common:
            counts = ", ".join(f"{name}: {len(mine)}" for name, mine in stamps.items())
            raise MissingFileError(
                f"images: {path}: no moment has an image of every camera within tolerance={tolerance:g} seconds "
                f"({counts} images)"
            )
        self.files = {
            frame: {name: matched[name][frame] for name in rig.names} for frame in sorted(common, key=int)
        }

    @contextmanager
    def _reader(self) -> Iterator[Any]:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore

        try:
            with AnyReader([self.path], default_typestore=get_typestore(Stores.LATEST)) as reader:
                yield reader
        except AnyReaderError as error:
            raise FileFormatError(f"{self.path}: rosbags cannot read it ({error})") from None

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Camera name -> (height, width) of its images, of the first frame."""
        images = self._pictures(next(iter(self.files.values())))
        return {name: (image.shape[0], image.shape[1]) for name, image in images.items()}

    def _images(self, files: Mapping[str, Any]) -> dict[str, npt.NDArray[np.uint8]]:
        """The images of a frame, of the calibration's sizes."""
        images = self._pictures(files)
        for name, image in images.items():
            height, width = self.rig.cameras[name].image_size
            if image.shape[:2] != (height, width):
                raise FileFormatError(
                    f"{self.path}: {self.topics[name]}: expected pictures of {width} x {height} pixels (width x "
                    f"height, from the calibration), got one of {image.shape[1]} x {image.shape[0]}"
                )
        return images

    def _pictures(self, files: Mapping[str, Any]) -> dict[str, npt.NDArray[np.uint8]]:
        """The images of a frame, by the times at which the bag has their messages."""
        images = {}
        with self._reader() as reader:
            for name, time in files.items():
                own = [each for each in reader.connections if each.topic == self.topics[name]]
                connection, _, data = next(reader.messages(connections=own, start=time, stop=time + 1))
                message = reader.deserialize(data, connection.msgtype)
                images[name] = _picture(message, f"{self.path}: {connection.topic}")
        return images


def _topics(connections: Sequence[Any], names: Sequence[str], path: Path) -> dict[str, str]:
    """Camera name -> topic."""
    for kind in KINDS:  # compressed where there is nothing else
        topics = sorted({c.topic for c in connections if c.msgtype == kind}, key=by_numbers)
        own = {name: [topic for topic in topics if name in topic.split("/")] for name in names}
        if all(len(matches) == 1 for matches in own.values()):
            return {name: topic for name, (topic,) in own.items()}
        if len(topics) == len(names):
            return dict(zip(names, topics, strict=True))
    listed = sorted(f"{c.topic} ({c.msgtype.rpartition('/')[2]})" for c in connections)
    raise ArgumentError(
        f"images: {path}: expected a topic of images for each of {', '.join(names)}, such as /{names[0]}/image_raw, "
        f"got {', '.join(listed) or 'none'}; rename the cameras of the calibration"
    )


def _picture(message: Any, where: str) -> npt.NDArray[np.uint8]:
    """The picture of a message, ``(h, w)`` or ``(h, w, 3)``, RGB.

    Raises:
        FileFormatError: its encoding is not known, or it is damaged.
    """
    if hasattr(message, "format"):
        picture = cv2.imdecode(message.data, cv2.IMREAD_COLOR)
        if picture is None:
            raise FileFormatError(f"{where}: OpenCV cannot read a picture of the format {message.format!r}")
        return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)  # type: ignore[return-value]
    mosaic = re.fullmatch(r"bayer_([rgb]{4})8", message.encoding)
    channels = 1 if mosaic else CHANNELS.get(message.encoding)
    if channels is None:
        raise FileFormatError(
            f"{where}: expected the encoding {', '.join(CHANNELS)} or a bayer_rggb8, got {message.encoding!r}"
        )
    rows = message.data.reshape(message.height, message.step)[:, : message.width * channels]
    image = rows.reshape(message.height, message.width, channels)
    if mosaic:
        code = getattr(cv2, f"COLOR_Bayer{mosaic[1].upper()}2RGB")
        return cv2.cvtColor(np.ascontiguousarray(image[..., 0]), code)  # type: ignore[return-value]
    if channels == 1:
        return image[..., 0]
    return np.ascontiguousarray(image[..., 2::-1] if message.encoding.startswith("bgr") else image[..., :3])
