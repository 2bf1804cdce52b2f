# SPDX-License-Identifier: Apache-2.0
"""Frames of videos, by PyAV: one for each camera, one with the views of all, or one with a stream for each camera."""

from __future__ import annotations

import re
import warnings
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from datetime import datetime
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sphericalvision.cameras import CameraRig
from sphericalvision.capture.sources.frames import Recording
from sphericalvision.capture.sources.joined_views import size_of_view
from sphericalvision.capture.sources.listings import listed_clock
from sphericalvision.capture.sources.moments import WHOLE_SECONDS, Clock, pair_moments
from sphericalvision.core import ArgumentError, FileFormatError, first_line
from sphericalvision.io.times import SAME_TIME

VIDEO_SUFFIXES = (
    *(".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv"),
    *(".insv", ".360", ".lrv", ".mts", ".m2ts", ".ts"),
)
"""The last ones are of 360 cameras and camcorders, maybe of several streams."""
MAX_MISSING = 2**20
"""Pictures that a header may count behind the end of a file; nine hours of them. A damaged one counts billions."""
Picture = npt.NDArray[np.uint8]


class VideoStream(NamedTuple):
    """A video stream as its file describes it: the pictures are not decoded.

    Attributes:
        file: that holds it.
        number: among the file's video streams, counted from 0.
        of: how many video streams the file has.
        size: (height, width) of its pictures.
        rate: pictures a second, 0 where the file does not say it.
        stamps: of the pictures in the order in which they are shown, in the unit of the stream.
        times: the same in seconds, None where the file has no stamps; also of what a header promises after the end.
        key_frames: positions of the pictures that can be decoded without others.
        damaged: positions of the pictures that the file cuts short.
        title: its name in the file, empty without one.
        begins: seconds at which a clock of the camera says that the recording began, by where the file says it.
    """

    file: Path
    number: int
    of: int
    size: tuple[int, int]
    rate: float
    stamps: list[int]
    times: list[float | None]
    key_frames: list[int]
    damaged: set[int]
    title: str
    begins: dict[str, float]

    def __str__(self) -> str:
        return f"stream {self.number} of {self.file}" if self.of > 1 else str(self.file)


class _Packet(NamedTuple):
    """A stored picture: its time in the unit of the stream, and whether it stands alone, or is cut short."""

    stamp: int | None
    is_key: bool
    is_cut: bool


def read_streams(file: str | Path) -> list[VideoStream]:
    """Read what a file says of its video streams, covers of albums left out: all of it is passed through once.

    Raises:
        ArgumentError: PyAV is not installed.
        FileFormatError: PyAV cannot open the file, or finds no video in it.
    """
    path = Path(file)
    with _open(path) as container:
        streams = _streams(container)
        packets: dict[int, list[_Packet]] = {stream.index: [] for stream in streams}
        for packet in _packets(container, streams) if streams else ():  # of none PyAV would give all
            if packet.size and not packet.is_discard:
                stamp = packet.dts if packet.pts is None else packet.pts
                packets[packet.stream.index].append(_Packet(stamp, packet.is_keyframe, packet.is_corrupt))
        if not any(packets.values()):
            raise FileFormatError(f"{path}: expected a video, but PyAV finds no picture in it; copy it again")
        return [
            _described(path, container, streams, number, packets[stream.index])
            for number, stream in enumerate(streams)
        ]


def _described(
    path: Path, container: Any, streams: Sequence[Any], number: int, packets: list[_Packet]
) -> VideoStream:
    stream = streams[number]
    rate, unit = float(stream.average_rate or 0), float(stream.time_base)
    times: list[float | None] = [None] * len(packets)
    if all(packet.stamp is not None for packet in packets):
        # A file has them in the order in which they are decoded, which may be another
        packets = sorted(packets)
        times = [packet.stamp * unit for packet in packets if packet.stamp is not None]
    missing = _missing(path, container, stream, times, bool(packets and packets[-1].is_cut))
    for _ in range(missing):  # what is missing has times, too, to be missing in the moments where it would be
        last = times[-1] if times else None
        times.append(None if last is None or not rate else last + 1 / rate)
    return VideoStream(
        path,
        number,
        len(streams),
        (stream.codec_context.height, stream.codec_context.width),
        rate,
        [position if packet.stamp is None else packet.stamp for position, packet in enumerate(packets)],
        times,
        [position for position, packet in enumerate(packets) if packet.is_key],
        {position for position, packet in enumerate(packets) if packet.is_cut},
        stream.metadata.get("title", stream.metadata.get("handler_name", "")),
        _begins(container.metadata | stream.metadata, rate),
    )


def _begins(metadata: Mapping[str, str], rate: float) -> dict[str, float]:
    """When a recording began: by a timecode, counted from midnight, and by a date."""
    begins = {}
    if (match := re.fullmatch(r"(\d+):(\d+):(\d+)[:;.](\d+)", metadata.get("timecode", ""))) and rate:
        hours, minutes, seconds, pictures = map(int, match.groups())
        begins["timecode"] = 3600 * hours + 60 * minutes + seconds + pictures / rate
    with suppress(ValueError):
        begins["creation_time"] = datetime.fromisoformat(metadata.get("creation_time", "")).timestamp()
    return begins


def _say_if_begun_apart(streams: Mapping[str, VideoStream], tolerance: float) -> list[str]:
    """A sentence on cameras whose files say that they did not begin at one moment, if they do.

    Clocks of cameras differ, and some write when a recording ended: that is no way to pair pictures.
    """
    for key, slack in (("timecode", tolerance), ("creation_time", WHOLE_SECONDS)):
        begins = {name: own.begins[key] for name, own in streams.items() if key in own.begins}
        first, last = (choose(begins, key=begins.__getitem__, default="") for choose in (min, max))
        if begins and (gap := begins[last] - begins[first]) > slack:
            return [
                f"images: by their {key} the videos of {first} and {last} begin {gap:.3g} s apart, and pictures are "
                "paired by the times since each begins; cut the videos so that they begin together, if they do not"
            ]
    return []


def _missing(path: Path, container: Any, stream: Any, times: Sequence[float | None], is_cut: bool) -> int:
    """How many pictures a header counts behind the end; a warning where it tells that some are, and not how many.

    Headers count what a cut in an editor leaves out, too: their number counts only where the duration says the same.
    """
    import av

    step = float(1 / (stream.average_rate or 1))
    length, slack = float((stream.duration or 0) * stream.time_base), 2 * step
    first, last = (times[0], times[-1]) if times else (None, None)
    if not length:  # then it is the container's, which counts from its own beginning
        length, first = (container.duration or 0) / av.time_base, None if first is None else min(first, 0.0)
        slack = 1.0 if len(container.streams) > 1 else slack  # sound may be longer than pictures
    covered = 0.0 if first is None or last is None else last - first + step
    if not is_cut and covered >= length - slack:
        return 0
    missing = max(stream.frames - len(times), 0)
    if not stream.frames or missing > MAX_MISSING:
        warnings.warn(
            f"{path}: pictures end after {covered:.3g} s of the {length:.3g} s that its header promises; if it was "
            "cut, copy it again",
            stacklevel=6,
        )
    return missing if missing <= MAX_MISSING else 0


@contextmanager
def _open(path: Path) -> Iterator[Any]:
    if find_spec("av") is None:
        raise ArgumentError(f"images: {path} is a video, which PyAV reads: pip install av")
    import av

    try:
        container = av.open(str(path))
    except (av.FFmpegError, OSError, ValueError) as error:
        raise FileFormatError(
            f"{path}: PyAV cannot open it as a video ({first_line(error)}); copy it again"
        ) from None
    with container:
        yield container


def _streams(container: Any) -> list[Any]:
    from av.stream import Disposition

    videos = container.streams.video
    streams = [stream for stream in videos if not stream.disposition & Disposition.attached_pic]
    if any(stream.codec_context is None for stream in streams):
        raise FileFormatError(f"{container.name}: PyAV knows no decoder of this video; convert it to H.264")
    return streams


def _packets(container: Any, streams: Any) -> Iterator[Any]:
    """Packets up to the end of the file, or to where it cannot be read any more."""
    import av

    packets = container.demux(streams)
    while True:
        try:
            packet = next(packets, None)
        except av.FFmpegError:
            return
        if packet is None:
            return
        yield packet


class _Decoder:
    """Pictures of a stream by position. Going on is quick; what lies far ahead, or back, begins at a key frame."""

    def __init__(self, stream: VideoStream, stack: ExitStack) -> None:
        self.stream, self._opened = stream, stack.enter_context(ExitStack())
        self._start()

    @cached_property
    def _positions(self) -> dict[int, int]:
        return {stamp: position for position, stamp in enumerate(self.stream.stamps)}

    def _decoded(self) -> Iterator[Any]:
        import av

        for packet in _packets(self._container, self._source):
            try:
                yield from packet.decode()
            except av.FFmpegError:  # its picture is missing then, those behind it are not
                continue

    def read(self, position: int) -> Picture:
        """The picture at a position ``(h, w, 3)``, RGB, as it is stored: not turned."""
        stream = self.stream
        if position >= len(stream.stamps):
            raise FileFormatError(
                f"{stream}: ends after {len(stream.stamps)} of the {len(stream.times)} frames that its header "
                f"promises; copy it again, or predict what is there with stop={len(stream.stamps)}"
            )
        before = bisect_right(stream.key_frames, position) - 1
        key_frame = stream.key_frames[before] if before >= 0 else 0
        if position < self._position or key_frame > self._position + 1:
            self._go_to(key_frame)
            self._step()
            if self._position > position:  # some containers know no exact places
                self._start()
        while self._position < position:
            self._step()
        if self._position > position or position in stream.damaged:
            raise FileFormatError(f"{stream}: frame {position} is damaged")
        picture: Picture = self._frame.to_ndarray(format="rgb24", interpolation="BICUBIC")
        return picture

    def _start(self) -> None:
        """Go to before the first picture."""
        self._opened.close()
        self._container = self._opened.enter_context(_open(self.stream.file))
        self._source = _streams(self._container)[self.stream.number]
        self._source.thread_type = "AUTO"
        self._position = -1  # of the picture decoded last
        self._frame: Any = None
        self._frames = self._decoded()

    def _go_to(self, position: int) -> None:
        import av

        with suppress(av.FFmpegError):  # of containers that know no places; it goes on from where it is then
            self._container.seek(self.stream.stamps[position], stream=self._source)
        self._position, self._frames = -1, self._decoded()

    def _step(self) -> None:
        """Decode the next picture; behind the last one the position is beyond all others."""
        self._frame = next(self._frames, None)
        if self._frame is None:
            self._position = len(self.stream.stamps)
            return
        # Stamps tell positions; a picture whose stamp no packet has follows the one before.
        self._position = self._positions.get(self._frame.pts, self._position + 1)


class Videos(Recording):
    """Frames of videos, called by their number in the first camera's; a picture is read by its position.

    Args:
        files: camera name -> file; or under the name ``""`` one that has all views, side by side or in a video stream
            for each camera, which have the cameras' names or their order.
        rig: of the cameras.
        whole: the rig whose cameras say how views lie side by side, of which ``rig`` has some; ``rig`` when not given.
        tolerance: seconds between images of one moment, at most.

    Raises:
        ArgumentError: a file has several streams, and not one for each camera.
        FileFormatError: PyAV cannot open one of them.
        MissingFileError: no moment has an image of every camera.
    """

    def __init__(
        self,
        files: Mapping[str, Path],
        rig: CameraRig,
        whole: CameraRig | None = None,
        tolerance: float = SAME_TIME,
    ) -> None:
        whole = rig if whole is None else whole
        self.streams = _streams_of_cameras(files, rig, whole)
        positions = {
            name: {f"{position:06d}": position for position in range(len(stream.times))}
            for name, stream in self.streams.items()
        }
        moments = pair_moments(positions, self._clocks(positions), tolerance, names="their numbers")
        if "next to them" not in moments.pairing:  # tables know when each began
            moments.warnings.extend(_say_if_begun_apart(self.streams, tolerance))
        super().__init__(moments, rig, whole)
        first = next(iter(self.streams.values()))
        self.rate, self._times = first.rate, moments.times
        self.labels = {name: f"stream {own.number}" for name, own in self.streams.items() if own.of > 1}

    def _clocks(self, positions: Mapping[str, Mapping[str, int]]) -> list[Clock]:
        """Times in the files; and, of several files, whose clocks may differ, those since each one's first picture.

        A table next to each file tells better: recorders write pictures at a steady rate, whenever they came.
        """
        times = {
            name: dict(zip(positions[name], stream.times, strict=True))
            for name, stream in self.streams.items()
        }
        clocks = [Clock("the times in the videos", times)]
        if len({stream.file for stream in self.streams.values()}) > 1:
            since = {name: _since_first(own) for name, own in times.items()}
            clocks.append(Clock("the times since the first picture of each video", since))
            files = {name: stream.file for name, stream in self.streams.items()}
            listed = listed_clock(
                {name: file.parent for name, file in files.items()},
                {name: file.stem for name, file in files.items()},
                {name: {str(int(number)): number for number in own} for name, own in positions.items()},
            )
            clocks = [listed, *clocks] if listed else clocks
        return clocks

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Camera name -> (height, width) of its images."""
        sizes = {name: stream.size for name, stream in self.streams.items()}
        return dict.fromkeys(self.rig.names, size_of_view(sizes[""], self.whole)) if "" in sizes else sizes

    def times(self) -> list[float]:
        """Seconds of each frame since the first, as the file has them: frames may last unevenly long."""
        if self._times is None:
            return [number / self.rate for number in range(len(self.moments))] if self.rate else []
        return [time - self._times[0] for time in self._times]

    @contextmanager
    def opened(self) -> Iterator[Callable[[str, Any], Any]]:
        """A function that decodes pictures by their positions."""
        with ExitStack() as stack:
            decoders = {name: _Decoder(stream, stack) for name, stream in self.streams.items()}
            yield lambda camera, position: decoders[camera].read(position)


def _streams_of_cameras(
    files: Mapping[str, Path], rig: CameraRig, whole: CameraRig
) -> dict[str, VideoStream]:
    """The stream of each file, or the streams of the one that has a stream for each camera."""
    streams = {}
    for name, file in files.items():
        described = read_streams(file)
        if len(described) == 1:
            streams[name] = described[0]
        elif name or len(described) != len(whole):
            raise ArgumentError(
                f"images: {file} has {len(described)} video streams, expected one for each of the {len(whole)} "
                f"camera(s) of the calibration in one file, or one alone in a file of each camera. Write each to a "
                f"file of its own: ffmpeg -i in{file.suffix} -map 0:v:0 -c copy cam1.mp4, and so on with 0:v:1"
            )
        else:
            titles = [stream.title for stream in described]
            order = titles if set(titles) == set(whole.names) else whole.names
            return {camera: described[order.index(camera)] for camera in rig.names}
    return streams


def _since_first(times: Mapping[str, float | None]) -> dict[str, float | None]:
    first = next((time for time in times.values() if time is not None), 0.0)
    return {name: None if time is None else time - first for name, time in times.items()}
