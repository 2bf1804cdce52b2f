# SPDX-License-Identifier: Apache-2.0
"""Frames of a ROS bag, of ROS 1 or 2, by the package rosbags: a topic of images, raw or compressed, for each camera."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from itertools import islice, zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from sphericalvision.cameras import CameraRig
from sphericalvision.capture.sources.frames import Recording
from sphericalvision.capture.sources.moments import Clock, pair_moments
from sphericalvision.capture.sources.patterns import is_called, labels_by_number
from sphericalvision.core import (
    ArgumentError,
    FileFormatError,
    MissingFileError,
    SphericalVisionError,
    first_line,
)
from sphericalvision.io.files import read_text
from sphericalvision.io.images import decode_image
from sphericalvision.io.times import SAME_TIME

SUFFIXES = (".bag", ".mcap", ".db3", ".bag.active", ".mcap.zstd", ".db3.zstd")
"""Of recordings, of one that was not ended, and of compressed files."""
JOIN = "rosbags-convert --src ONE OTHER --dst JOINED"
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CHANNELS = {
    "mono8": 1,
    "8UC1": 1,
    "mono16": 1,
    "rgb8": 3,
    "bgr8": 3,
    "8UC3": 3,
    "rgba8": 4,
    "bgra8": 4,
    "8UC4": 4,
}
"""Of raw pictures, by encoding; 8UC3 and 8UC4 are OpenCV's, whose first channel is blue."""
DEPTH = re.compile("(16|32|64)|.*compressedDepth")
"""Encoding or format of images whose values are no brightness."""
STEADY = 0.3
"""Seconds by which the time from a stamp to its receipt may vary."""
FASTER = 10
"""How many times as fast images are never taken as they are received."""
FEWEST_FOR_DRIFT = 20
"""Images of a third of a recording, below which their delays say nothing about clocks."""
MAX_DELAY = 10.0
"""Seconds that an image may take from the camera to the bag."""
MOSAIC = re.compile(r"bayer_([rgb]{4})8")
"""Encoding of what a sensor with a mosaic of colours saw."""
Picture = npt.NDArray[Any]


class Message(NamedTuple):
    """Where a bag has a message: when it received it, and how many of the same topic and time come before."""

    time: int
    number: int


def bag_of(path: Path) -> Path | None:
    """The bag that a path names, as rosbags takes it: a folder with ``metadata.yaml``, else a file; None without one.

    Raises:
        MissingFileError: no such file.
        FileFormatError: a pipe or a device is in the folder.
        ArgumentError: rosbags is not installed.
    """
    is_folder = (path / "metadata.yaml").is_file()
    if not path.name.lower().endswith(SUFFIXES) and not is_folder:
        return None
    if not is_folder and not path.is_file():
        raise MissingFileError(
            f"images: {path}: no such bag of ROS 1 or 2, a file or a folder with metadata.yaml. One bag has the topics "
            f"of all cameras: {JOIN} makes one of several"
        )
    pipes = [file for file in path.iterdir() if not (file.is_file() or file.is_dir())] if is_folder else []
    if pipes:  # rosbags opens what metadata.yaml names, and waits
        raise FileFormatError(
            f"images: {pipes[0]}: expected a file of a bag; remove it, or copy the bag again"
        )
    if find_spec("rosbags") is None:
        raise ArgumentError(f"images: {path} is a bag, which rosbags reads: pip install rosbags")
    return path.parent if is_part(path) else path


def is_part(file: Path) -> bool:
    """Whether ``metadata.yaml`` next to a file of a bag names it."""
    listing = file.parent / "metadata.yaml"
    return listing.is_file() and file.name.removesuffix(".zstd") in read_text(listing)


class Bag(Recording):
    """Frames of a bag, called by the first camera's times in nanoseconds; an image is read by its ``Message``.

    Times are the stamps in the headers; where these do not tell, those at which the bag received the messages.

    Args:
        path: as ``bag_of`` has it.
        rig: of the cameras that are used.
        whole: the rig that decides which topic is whose.
        tolerance: seconds between images of one moment, at most.
        topics: camera name -> topic, of cameras whose topic is not to be found by name.

    Raises:
        ArgumentError: which topic is whose cannot be told.
        FileFormatError: the bag cannot be read.
        MissingFileError: no moment has an image of every camera.
    """

    def __init__(
        self,
        path: Path,
        rig: CameraRig,
        whole: CameraRig,
        tolerance: float = SAME_TIME,
        topics: Mapping[str, str] | None = None,
    ) -> None:
        from rosbags.typesys import Stores, get_typestore

        self.path = path
        self._is_ros1 = ".bag" in Path(path.name.lower()).suffixes
        # Not the definitions in the bag, of which one of another topic that is damaged would end the reading.
        types = get_typestore(Stores.ROS1_NOETIC if self._is_ros1 else Stores.LATEST)
        self._deserialize = types.deserialize_ros1 if self._is_ros1 else types.deserialize_cdr
        faults: Counter[tuple[str, str]] = Counter()
        with self._reader() as reader:
            self.topics = _topics(self._pictured(reader), whole.names, rig.names, topics or {}, path)
            stamps, messages = self._index(reader, rig.names, faults)
        received = {
            name: {key: message.time for key, message in own.items()} for name, own in messages.items()
        }
        clocks: list[tuple[str, Mapping[str, Mapping[str, int | None]]]] = [
            ("the stamps in their headers", stamps),
            ("the times at which the bag received them", received),
        ]
        sentences = []
        if (fault := _fault_of_stamps(stamps, received)) is not None:
            sentences.append(f"{clocks.pop(0)[0]} are {fault}: {clocks[0][0]} count")
        moments = pair_moments(
            messages,
            [
                Clock(source, {c: {n: t and t / 1e9 for n, t in own.items()} for c, own in times.items()})
                for source, times in clocks
            ],
            tolerance,
            names="their numbers",
        )
        parts = [file for file in path.glob("*") if file.name.lower().endswith(SUFFIXES)]
        if unnamed := sorted(file.name for file in parts if not is_part(file)):
            sentences.append(f"left out are {', '.join(unnamed)}, which metadata.yaml does not name")
        if fault is None and moments.clock == 0 and (drift := _drift(stamps, received, tolerance)):
            sentences.append(drift)
        moments.warnings[:0] = [f"images: {path}: {sentence}" for sentence in sentences]
        for (name, fault), count in faults.items():
            moments.warnings.append(
                f"images: {path}: {count} {fault} message(s) of {self.topics[name]} are left out"
            )
        if moments.clock is not None:
            names = clocks[moments.clock][1][rig.names[0]]
            moments = moments._replace(frames={str(names[n]): frame for n, frame in moments.frames.items()})
        super().__init__(moments, rig, whole)
        if any(name not in topic.split("/") for name, topic in self.topics.items()):
            self.labels = dict(self.topics)

    @contextmanager
    def _reader(self) -> Iterator[Any]:
        from rosbags import rosbag1, rosbag2

        with self._own_words():
            reader = rosbag1.Reader(self.path) if self._is_ros1 else rosbag2.Reader(self.path)
            reader.open()
        try:
            yield reader
        finally:
            reader.close()

    @contextmanager
    def _own_words(self) -> Iterator[None]:
        """Say in one sentence what rosbags raises of a damaged bag: errors of any type, of the libraries below it."""
        try:
            yield
        except SphericalVisionError:
            raise
        except Exception as error:
            raise FileFormatError(
                f"{self.path}: rosbags cannot read this bag ({first_line(error)}). If it is damaged or was cut, copy "
                "it again, or repair it with 'rosbag reindex', 'ros2 bag reindex' or 'mcap recover'; channels that "
                "are not of ROS, as of json or protobuf, are taken out by 'mcap filter'"
            ) from None

    def _pictured(self, reader: Any) -> dict[str, int]:
        """Topics whose first message is a picture: no depth, which is an image message, too; and their messages."""
        topics: dict[tuple[str, str], list[Any]] = {}
        for connection in reader.connections:
            topics.setdefault((connection.topic, connection.msgtype), []).append(connection)
        pictured, others = {}, []
        for (topic, kind), connections in sorted(topics.items()):
            encoding = ""
            if kind in (IMAGE, COMPRESSED):
                with self._own_words():
                    messages = (message for _, _, message in self._messages(reader, connections))
                    first = next((message for message in messages if message is not None), None)
                encoding = getattr(first, "encoding", getattr(first, "format", "no message can be read"))
                if first is not None and not DEPTH.match(encoding):
                    pictured[topic] = sum(connection.msgcount for connection in connections)
            others.append(f"{topic} ({kind}{encoding and ': '}{encoding})")
        if not pictured:
            raise ArgumentError(
                f"images: {self.path}: expected topics of {IMAGE} or {COMPRESSED} with pictures, got "
                f"{', '.join(others)[:300] or 'none'}; decode videos, or convert encodings, to such images first"
            )
        return pictured

    def _messages(self, reader: Any, connections: Sequence[Any]) -> Iterator[tuple[str, int, Any]]:
        """Topic, time and content of messages; None of a damaged one, for which rosbags raises errors of many types."""
        for connection, time, data in reader.messages(connections=connections):
            try:
                yield connection.topic, time, self._deserialize(data, connection.msgtype)
            except Exception:
                yield connection.topic, time, None

    def _index(
        self, reader: Any, names: Sequence[str], faults: Counter[tuple[str, str]]
    ) -> tuple[dict[str, dict[str, int | None]], dict[str, dict[str, Message]]]:
        """Stamp and message of every image: camera -> its number in its topic -> nanoseconds, and where it is."""
        cameras = {self.topics[name]: name for name in names}
        stamps: dict[str, dict[str, int | None]] = {name: {} for name in names}
        messages: dict[str, dict[str, Message]] = {name: {} for name in names}
        before: Counter[tuple[str, int]] = Counter()
        read: set[tuple[str, int, int]] = set()
        with self._own_words():
            used = [connection for connection in reader.connections if connection.topic in cameras]
            for topic, time, content in self._messages(reader, used):
                name = cameras[topic]
                message = Message(time, before[name, time])
                before[name, time] += 1
                if content is None:
                    faults[name, "damaged"] += 1
                    continue
                stamp = 10**9 * content.header.stamp.sec + content.header.stamp.nanosec
                step = max(1, len(content.data) // 4096)  # noise differs everywhere
                picture = name, stamp, hash(content.data[::step].tobytes())
                if stamp and picture in read:
                    faults[name, "repeated"] += 1
                    continue
                read.add(picture)
                number = f"{len(messages[name]):06d}"
                messages[name][number] = message
                stamps[name][number] = stamp or None  # which drivers leave at 0
        return stamps, messages

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Camera name -> (height, width) of its images, of the first frame that can be read."""
        with self._reader() as reader:
            for frame in list(self.moments.values())[:3]:
                with suppress(FileFormatError):
                    pictures = {name: self._picture(reader, name, message) for name, message in frame.items()}
                    return {name: (picture.shape[0], picture.shape[1]) for name, picture in pictures.items()}
        return {}

    @contextmanager
    def opened(self) -> Iterator[Callable[[str, Any], Any]]:
        """A function that reads pictures by their messages, of the calibration's sizes."""
        with self._reader() as reader:

            def read(camera: str, message: Message) -> Picture:
                picture = self._picture(reader, camera, message)
                height, width = self.rig.cameras[camera].image_size
                if picture.shape[:2] != (height, width):
                    raise FileFormatError(
                        f"{self.path}: {self.topics[camera]}: expected pictures of {width} x {height} pixels (width x "
                        f"height, from the calibration), got one of {picture.shape[1]} x {picture.shape[0]}"
                    )
                return picture

            yield read

    def _picture(self, reader: Any, camera: str, message: Message) -> Picture:
        topic = self.topics[camera]
        with self._own_words():
            connections = [connection for connection in reader.connections if connection.topic == topic]
            messages = reader.messages(connections=connections, start=message.time, stop=message.time + 1)
            connection, _, data = next(islice(messages, message.number, None))
            content = self._deserialize(data, connection.msgtype)
        return _picture_of(content, f"{self.path}: {topic}")


def _fault_of_stamps(
    stamps: Mapping[str, Mapping[str, int | None]], received: Mapping[str, Mapping[str, int]]
) -> str | None:
    """Why stamps are no times of one clock: of another unit, or of clocks that count from when each was switched on.

    Stamps that are far closer than the receipts are of another unit, as microseconds that stand for nanoseconds.
    Each camera's images are received a steady time after their stamps, and not the same time. On a slow way that is up
    to ``MAX_DELAY`` with one clock, too; what comes in bursts tells nothing.
    """
    for camera in stamps:
        step, gap = (
            float(np.median([0, *np.diff(sorted(filter(None, times[camera].values())))])) / 1e9
            for times in (stamps, received)
        )
        if 0 < FASTER * step < gap:
            return f"{step:.2g} s apart, where the bag received images of {camera} {gap:.2g} s apart"
    medians = {}
    for camera, delays in _delays(stamps, received).items():
        if not len(delays) or np.ptp(np.quantile(delays, [0.1, 0.9])) > STEADY:
            return None
        medians[camera] = float(np.median(delays))
    first, last = (choose(medians, key=medians.__getitem__) for choose in (min, max))
    if medians[last] - medians[first] <= STEADY or 0 <= medians[first] <= medians[last] <= MAX_DELAY:
        return None
    return f"of clocks {medians[last] - medians[first]:.3g} s apart ({first} and {last})"


def _delays(
    stamps: Mapping[str, Mapping[str, int | None]], received: Mapping[str, Mapping[str, int]]
) -> dict[str, npt.NDArray[np.float64]]:
    """Seconds from the stamp of each image of a camera to its receipt."""
    return {
        camera: np.array([received[camera][n] - stamp for n, stamp in own.items() if stamp]) / 1e9
        for camera, own in stamps.items()
    }


def _drift(
    stamps: Mapping[str, Mapping[str, int | None]],
    received: Mapping[str, Mapping[str, int]],
    tolerance: float,
) -> str | None:
    """A sentence on clocks of which one is faster, so that images of one moment have other stamps in the end.

    The way of an image takes a time that varies, and hardly ever less than its least, by which clocks are compared.
    """
    drifts = {}
    for camera, delays in _delays(stamps, received).items():
        third = len(delays) // 3
        if third < FEWEST_FOR_DRIFT:
            return None
        drifts[camera] = float(delays[-third:].min() - delays[:third].min())
    first, last = (choose(drifts, key=drifts.__getitem__) for choose in (min, max))
    if drifts[last] - drifts[first] <= tolerance:
        return None
    return (
        f"the clocks of {first} and {last} drift apart by {drifts[last] - drifts[first]:.2g} s, as the times at which "
        "the bag received their images show: by stamps, late images are paired with those of other moments; correct "
        "the stamps, or take a part with start= and stop="
    )


def _topics(
    topics: Mapping[str, int],
    names: Sequence[str],
    used: Sequence[str],
    chosen: Mapping[str, str],
    path: Path,
) -> dict[str, str]:
    """Camera name -> topic: the one chosen for it, of its name, or of its number.

    Args:
        topics: of pictures, raw and compressed, and how many messages each has.
        names: cameras of the whole rig.
        used: cameras in use.
        chosen: camera name -> topic.
        path: of the bag, for messages.
    """
    # What image_transport publishes raw and compressed is one picture, of which the raw one is as it was taken; unless
    # only a few of those were recorded.
    single = []
    for topic in topics:
        raw = topic.removesuffix("/compressed")
        packed = f"{raw}/compressed"
        is_raw_better = raw in topics and 2 * topics[raw] >= topics.get(packed, 0)
        if topic == (raw if is_raw_better else packed):
            single.append(topic)
    own = {
        name: sorted({chosen[name]} & set(topics))
        if name in chosen
        else [topic for topic in single if is_called(topic, name)]
        for name in used
    }
    single_topics = {topic for matches in own.values() if len(matches) == 1 for topic in matches}
    if len(single_topics) == len(used):
        return {name: topic for name, (topic,) in own.items()}
    if not chosen and not any(own.values()) and (numbered := _numbered(single)):
        labels = labels_by_number(list(numbered), names, used)
        if labels is not None:
            return {name: numbered[label] for name, label in labels.items()}
    unclear = next((f", {name} may be {' or '.join(own[name])}" for name in used if len(own[name]) > 1), "")
    raise ArgumentError(
        f"images: {path}: expected one topic of pictures for each of {', '.join(used)}, such as /{used[0]}/image_raw, "
        f"got {', '.join(sorted(topics))}{unclear}. Say which is whose: "
        f"cameras=[{','.join(f'{name}:/topic' for name in used)}]"
    )


def _numbered(topics: Sequence[str]) -> dict[str, str]:
    """Number -> topic, of topics that differ in one number alone; none of others."""
    columns = zip_longest(*(re.split(r"(\d+)", topic) for topic in topics))
    differing = [column for column in columns if len(set(column)) > 1]
    is_numbered = len(differing) == 1 and all(text and text.isdecimal() for text in differing[0])
    return dict(zip(differing[0], topics, strict=True)) if is_numbered else {}


def _picture_of(message: Any, where: str) -> Picture:
    """The picture of a message, ``(h, w)`` or ``(h, w, 3)``, RGB, of 8 or 16 bits."""
    if hasattr(message, "format"):
        return _decompressed(message, where)
    is_mosaic = MOSAIC.fullmatch(message.encoding) is not None
    channels = 1 if is_mosaic else CHANNELS.get(message.encoding)
    if channels is None:
        raise FileFormatError(
            f"{where}: expected the encoding {', '.join(CHANNELS)} or a bayer_rggb8, got {message.encoding!r}; convert "
            "it first, as image_proc does"
        )
    dtype: np.dtype[Any] = np.dtype(np.uint8)
    if message.encoding == "mono16":
        dtype = np.dtype(">u2" if message.is_bigendian else "<u2")
    height, width, step, size = message.height, message.width, message.step, message.data.size
    row = width * channels * dtype.itemsize
    if min(height, width) < 1 or step < row or size < height * step:
        raise FileFormatError(
            f"{where}: is damaged: {width} x {height} pixels (width x height) of {message.encoding} in rows of {step} "
            f"bytes need {row} bytes a row and {height * step} in all, got {size}"
        )
    rows = np.ascontiguousarray(message.data[: height * step].reshape(height, step)[:, :row]).view(dtype)
    image = rows.reshape(height, width, channels).astype(dtype.newbyteorder("="))
    return _in_colors(image[..., 0] if channels == 1 else image, message.encoding)


def _decompressed(message: Any, where: str) -> Picture:
    """The picture of a compressed message, whose format is ``jpeg``, or ``rgb8; jpeg compressed bgr8``.

    The first word says what the camera gave, the last one the order in which channels were handed to OpenCV, which
    takes the first for blue: without ``bgr`` there, red and blue are exchanged in the file. A mosaic stays one.

    References:
        image_transport_plugins, compressed_image_transport/src/compressed_subscriber.cpp.
    """
    image = decode_image(message.data, where, f"a picture of the format {message.format!r}")
    encoding, separator, compression = message.format.partition(";")
    encoding = encoding.strip()
    if image.ndim == 2:
        return _in_colors(image, encoding if MOSAIC.fullmatch(encoding) else "mono8")
    is_exchanged = bool(separator) and "compressed" in compression and "compressed bgr" not in compression
    return _in_colors(image, "bgr8" if is_exchanged and CHANNELS.get(encoding, 1) > 1 else "rgb8")


def _in_colors(image: Picture, encoding: str) -> Picture:
    """A picture by its encoding as ``(h, w)`` or RGB ``(h, w, 3)``."""
    if mosaic := MOSAIC.fullmatch(encoding):
        code = getattr(cv2, f"COLOR_Bayer{mosaic[1].upper()}2RGB")
        return cv2.cvtColor(np.ascontiguousarray(image), code)
    if image.ndim == 2:
        return image
    is_blue_first = encoding.startswith(("bgr", "8UC"))
    return np.ascontiguousarray(image[..., 2::-1] if is_blue_first else image[..., :3])
