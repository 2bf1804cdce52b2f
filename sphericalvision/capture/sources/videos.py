# SPDX-License-Identifier: Apache-2.0
"""Frames of videos and live cameras: one for each camera, one with views side by side, or one of several streams."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy.typing as npt

from sphericalvision.cameras import CameraRig
from sphericalvision.capture.sources.frames import Frame, Selection
from sphericalvision.capture.sources.joined_views import size_of_view, split_views
from sphericalvision.capture.sources.streams import OF_360_CAMERAS, Stream, StreamCapture, count_streams
from sphericalvision.core import ArgumentError, FileFormatError

__all__ = ["VIDEO_SUFFIXES", "Videos"]

VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv", *OF_360_CAMERAS)
COUNTED = (".mp4", ".avi", ".mov", ".m4v", ".insv", ".360", ".lrv")
"""Those whose headers say how many frames there are."""
Picture = npt.NDArray[Any]
Opened = dict[str, cv2.VideoCapture | StreamCapture]


class Videos:
    """Frames of videos or live cameras.

    Args:
        files: camera name -> file or index of a device; or under the name ``""`` one that has all views, side by side
            or in a video stream for each camera, in their order.
        rig: of the cameras.
        whole: the rig whose cameras say how views lie side by side, of which ``rig`` has some; ``rig`` when not given.

    Raises:
        ArgumentError: rates differ, so that frames of one number are of different moments; or a file has several
            streams, and not one for each camera.
        FileFormatError: OpenCV cannot open or decode one of them.
    """

    def __init__(
        self, files: Mapping[str, Path | int], rig: CameraRig, whole: CameraRig | None = None
    ) -> None:
        self.rig, self.whole = rig, rig if whole is None else whole
        self.labels: dict[str, str] = {}
        self.files = self._with_streams(files)
        self._sampled: list[Frame] = []
        self.live = isinstance(next(iter(self.files.values())), int)
        with ExitStack() as stack:
            videos = self._open(stack)
            rates = {name: video.get(cv2.CAP_PROP_FPS) or 0.0 for name, video in videos.items()}
            self.rate = next(iter(rates.values()))
            counts = {name: int(video.get(cv2.CAP_PROP_FRAME_COUNT)) for name, video in videos.items()}
            self.picture_sizes = {
                name: (int(video.get(cv2.CAP_PROP_FRAME_HEIGHT)), int(video.get(cv2.CAP_PROP_FRAME_WIDTH)))
                for name, video in videos.items()
            }
        if not self.live:
            _check_rates(rates, counts)
        fewest, most = min(counts.values()), max(counts.values())
        self.num_frames = None if self.live or fewest <= 0 else fewest
        if self.num_frames and fewest < most:
            listed = ", ".join(f"{name} {count}" for name, count in counts.items())
            warnings.warn(
                f"images: the videos have different numbers of frames ({listed}); "
                f"{most - fewest} that not all cameras have are left out",
                stacklevel=2,
            )

    def _with_streams(self, files: Mapping[str, Path | int]) -> dict[str, Path | int | Stream]:
        """Files, or the streams of the one that has a stream for each camera, which are labels then."""
        for name, file in files.items():
            if isinstance(file, int) or (number := count_streams(file)) == 1:
                continue
            if name or number != len(self.whole):
                raise ArgumentError(
                    f"images: {file} has {number} video streams, expected one for each of the {len(self.whole)} "
                    f"camera(s) of the calibration in one file, or one alone in a file of each camera. Write each to a "
                    f"file of its own: ffmpeg -i in{file.suffix} -map 0:v:0 -c copy cam1.mp4, and so on with 0:v:1"
                )
            places = {name: self.whole.names.index(name) for name in self.rig.names}
            self.labels = {name: f"stream {place}" for name, place in places.items()}
            return {name: Stream(file, place) for name, place in places.items()}
        return dict(files)

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Camera name -> (height, width) of its images."""
        if "" not in self.picture_sizes:
            return self.picture_sizes
        return dict.fromkeys(self.rig.names, size_of_view(self.picture_sizes[""], self.whole))

    def times(self) -> list[float]:
        """Seconds of each frame since the first, as the file has them: frames may last unevenly long.

        The whole video of the first camera is passed through; where it has no times, they follow from its rate.
        """
        times: list[float] = []
        with ExitStack() as stack:
            video = next(iter(self._open(stack).values()))
            while video.grab():
                times.append(video.get(cv2.CAP_PROP_POS_MSEC) / 1000)
        if len(times) < 2 or not all(before < after for before, after in pairwise(times)):
            return [number / self.rate for number in range(len(times))] if self.rate else []
        return [time - times[0] for time in times]

    def names(self, selection: Selection) -> list[str] | None:
        """Names of the frames chosen; None where nobody knows how many there are."""
        if self.num_frames is None:
            return None
        return [_name(number) for number in selection.positions(self.num_frames)]

    def samples(self) -> list[Frame]:
        """The first, the middle and the last frame; none of live cameras."""
        if self.live or self._sampled:
            return self._sampled
        last = (self.num_frames or 1) - 1
        with ExitStack() as stack:
            videos = self._open(stack)
            for number in sorted({0, last // 2, max(last - 1, 0)}):
                for video in videos.values():
                    video.set(cv2.CAP_PROP_POS_FRAMES, number)
                images = {name: video.read()[1] for name, video in videos.items()}
                if all(image is not None for image in images.values()):
                    self._sampled.append(Frame(_name(number), self._by_camera(images)))
        return self._sampled

    def frames(self, selection: Selection, wanted: Callable[[str], bool]) -> Iterator[Frame]:
        """The frames chosen, one after the other; what is not wanted is passed over without being decoded."""
        with ExitStack() as stack:
            videos = self._open(stack)
            number = -1
            while selection.stop is None or number + 1 < selection.stop:
                number += 1
                grabbed = [video.grab() for video in videos.values()]
                if not all(grabbed):
                    ended = list(self.files.values())[grabbed.index(False)]
                    yield from self._missing(ended, number, selection, wanted)
                    return
                if number not in selection or not wanted(_name(number)):
                    continue
                images = {name: video.retrieve()[1] for name, video in videos.items()}
                broken = [str(self.files[name]) for name, image in images.items() if image is None]
                if broken:
                    yield Frame(
                        _name(number), None, FileFormatError(f"{broken[0]}: frame {number} is damaged")
                    )
                    continue
                yield Frame(_name(number), self._by_camera(images))

    def _missing(
        self, file: Path | int | Stream, number: int, selection: Selection, wanted: Callable[[str], bool]
    ) -> Iterator[Frame]:
        """Frames after the end of a video that its header promises, chosen and wanted; each says why it is not there.

        Containers whose headers count no frames tell how long they last, of which OpenCV makes a number. Matroska's
        tell their size as well: only what is shorter was cut. Of others the number may be off by a second.
        """
        promised = self.num_frames or 0
        if promised > number and not str(file).lower().endswith(COUNTED):
            cut = _is_cut(Path(file.file if isinstance(file, Stream) else str(file)))
            promised = promised if cut or (cut is None and promised - number > self.rate) else number
        error = FileFormatError(
            f"{file}: ends after {number} of the {promised} frames that its header promises; copy it again, or "
            f"predict what is there with stop={number}"
        )
        for missing in range(number, promised):
            if missing in selection and wanted(_name(missing)):
                yield Frame(_name(missing), None, error)

    def _by_camera(self, images: Mapping[str, Picture]) -> dict[str, Picture]:
        rgb = {name: cv2.cvtColor(image, cv2.COLOR_BGR2RGB) for name, image in images.items()}
        if "" not in rgb:
            return rgb
        views = split_views(rgb[""], self.whole)
        return {name: views[name] for name in self.rig.names}

    def _open(self, stack: ExitStack) -> Opened:
        videos: Opened = {}
        for name, file in self.files.items():
            video: Any
            if isinstance(file, Stream):
                video = StreamCapture(file)
            else:
                video = cv2.VideoCapture(file if isinstance(file, int) else str(file))
            stack.callback(video.release)
            video.set(
                cv2.CAP_PROP_ORIENTATION_AUTO, 0
            )  # as image files: calibrations are of what the sensor stores
            if not video.isOpened():
                what = f"camera {file} of this machine" if isinstance(file, int) else str(file)
                raise FileFormatError(
                    f"{what}: OpenCV cannot open it; is it there, free, and of a codec that OpenCV was built with?"
                )
            videos[name] = video
        return videos


def _check_rates(rates: Mapping[str, float], counts: Mapping[str, int]) -> None:
    """Refuse rates that differ by 2 % and more, and warn of less where it adds up to a frame."""
    stated = {name: rate for name, rate in rates.items() if rate > 0}
    if len(stated) < 2:
        return
    slowest, fastest = min(stated.values()), max(stated.values())
    listed = ", ".join(f"{name} {rate:.5g}" for name, rate in stated.items())
    if fastest > 1.02 * slowest:
        raise ArgumentError(
            f"images: the videos have different rates ({listed} frames a second), so that frames of one number are of "
            f"different moments; write them anew at one rate, such as ffmpeg -i in.mp4 -r {slowest:.5g} out.mp4"
        )
    drift = min(counts.values()) * (1 / slowest - 1 / fastest)
    if drift * fastest > 1:
        warnings.warn(
            f"images: the videos have different rates ({listed} frames a second); the last frames of one number are up "
            f"to {drift:.2g} s apart",
            stacklevel=3,
        )


def _name(number: int) -> str:
    return f"{number:06d}"


def _is_cut(file: Path) -> bool | None:
    """Whether a Matroska file is shorter than its segment; None of other files and of segments of unknown size.

    References:
        RFC 8794, 4 (sizes: as many bytes as the first has leading zeros, and one) and RFC 9559, 5.1 (the segment).
    """
    with file.open("rb") as stream:
        head = stream.read(4096)
    at = head.find(b"\x18\x53\x80\x67") + 4
    if not head.startswith(b"\x1a\x45\xdf\xa3") or at < 4 or at >= len(head) or not head[at]:
        return None
    length = 9 - head[at].bit_length()
    unknown = (1 << 7 * length) - 1
    size = int.from_bytes(head[at : at + length], "big") & unknown
    return None if size == unknown else file.stat().st_size < at + length + size
