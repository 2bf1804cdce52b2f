# SPDX-License-Identifier: Apache-2.0
"""Containers with several video streams, as 360 cameras write them, by PyAV: OpenCV opens the first stream alone."""

from __future__ import annotations

import re
import warnings
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import cv2

from sphericalvision.core import ArgumentError, FileFormatError

__all__ = ["OF_360_CAMERAS", "Stream", "StreamCapture", "count_streams"]

OF_360_CAMERAS = (".insv", ".360", ".lrv", ".mts", ".m2ts", ".ts")
"""Suffixes of 360 cameras and camcorders, whose files may hold several streams."""


class Stream(NamedTuple):
    """A video stream of a file, counted from 0."""

    file: Path
    number: int

    def __str__(self) -> str:
        return f"stream {self.number} of {self.file}"


def count_streams(file: Path) -> int:
    """The number of video streams, without pictures of covers; 1 of what no container is known of.

    Raises:
        ArgumentError: a file with several, or whose suffix lets expect them, and no PyAV.
    """
    if find_spec("av") is None:
        tracks = _tracks_of_mp4(file)
        if (tracks or 1) > 1 or (tracks is None and file.suffix.lower() in OF_360_CAMERAS):
            raise ArgumentError(
                f"images: {file} {'may hold' if tracks is None else 'holds'} several video streams, which PyAV reads: "
                "pip install 'sphericalvision[video]'"
            )
        if tracks is None:
            warnings.warn(
                f"{file}: without PyAV nobody looks for a second video stream, and the first is read "
                "(pip install 'sphericalvision[video]')",
                stacklevel=2,
            )
        return 1
    import av

    try:
        with av.open(str(file)) as container:
            return max(len(_streams(container)), 1)
    except (av.FFmpegError, OSError):
        return 1  # OpenCV says what is wrong


def _tracks_of_mp4(file: Path) -> int | None:
    """The number of video tracks in the header of an MP4 file; None of other files.

    References:
        ISO/IEC 14496-12, 4.2 (boxes) and 8.4.3 (the handler box).
    """
    with file.open("rb") as stream:
        while len(head := stream.read(8)) == 8:
            size, before = int.from_bytes(head[:4], "big"), 8
            if size == 1:
                size, before = int.from_bytes(stream.read(8), "big"), 16
            if size < before:
                return None
            if head[4:] == b"moov":
                return len(re.findall(rb"hdlr.{8}vide", stream.read(size - before), re.DOTALL))
            stream.seek(size - before, 1)
    return None


def _streams(container: Any) -> list[Any]:
    from av.stream import Disposition

    return [stream for stream in container.streams.video if not stream.disposition & Disposition.attached_pic]


class StreamCapture:
    """One stream as ``cv2.VideoCapture`` has the first of a file: what ``Videos`` asks for; images are BGR, not turned.

    Args:
        stream: which one.

    Raises:
        FileFormatError: PyAV cannot open the file.
    """

    def __init__(self, stream: Stream) -> None:
        import av

        try:
            self._container = av.open(str(stream.file))
        except (av.FFmpegError, OSError) as error:
            raise FileFormatError(f"{stream.file}: PyAV cannot open it ({error})") from None
        self._stream = _streams(self._container)[stream.number]
        self._stream.thread_type = "AUTO"
        self._errors = av.FFmpegError
        self._frames = self._container.decode(self._stream)
        self._frame: Any = None

    def isOpened(self) -> bool:
        """True."""
        return True

    def get(self, key: int) -> float:
        """Frames a second, their number, height or width, or the milliseconds of the frame grabbed last."""
        stream = self._stream
        rate = float(stream.average_rate or 0)
        length = float(stream.duration * stream.time_base) if stream.duration else 0.0
        milliseconds = 0.0 if self._frame is None else 1000 * (self._frame.time or 0.0)
        return {
            cv2.CAP_PROP_FPS: rate,
            cv2.CAP_PROP_FRAME_COUNT: stream.frames or round(length * rate),
            cv2.CAP_PROP_FRAME_HEIGHT: stream.codec_context.height,
            cv2.CAP_PROP_FRAME_WIDTH: stream.codec_context.width,
            cv2.CAP_PROP_POS_MSEC: milliseconds,
        }[key]

    def set(self, key: int, value: float) -> bool:
        """Go to before a frame, by its time at the stream's rate; other keys have no meaning here."""
        if key != cv2.CAP_PROP_POS_FRAMES:
            return False
        stream = self._stream
        place = (stream.start_time or 0) + int(value / float(stream.average_rate) / stream.time_base)
        self._container.seek(place, stream=stream)
        self._frames = (
            frame for frame in self._container.decode(stream) if frame.pts is None or frame.pts >= place - 1
        )
        return True

    def grab(self) -> bool:
        """Go on to the next frame; False at the end, and where the stream is damaged."""
        try:
            self._frame = next(self._frames, None)
        except self._errors:
            self._frame = None
        return self._frame is not None

    def retrieve(self) -> tuple[bool, Any]:
        """Whether there is a frame, and its image ``(h, w, 3)``, BGR."""
        return (False, None) if self._frame is None else (True, self._frame.to_ndarray(format="bgr24"))

    def read(self) -> tuple[bool, Any]:
        """The next frame, as ``retrieve`` has it."""
        self.grab()
        return self.retrieve()

    def release(self) -> None:
        """Close the file."""
        self._container.close()
