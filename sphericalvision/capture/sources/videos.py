# SPDX-License-Identifier: Apache-2.0
"""Frames of video files and live cameras, by OpenCV: one for each camera, or one with the views side by side."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from sphericalvision.cameras import CameraRig
from sphericalvision.capture.sources.frames import Frame, Selection
from sphericalvision.core import ArgumentError, FileFormatError

__all__ = ["VIDEO_SUFFIXES", "Videos", "split_views", "views_layout"]

VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv")
COUNTED = (".mp4", ".avi", ".mov", ".m4v")
"""Those whose headers say how many frames there are."""
Picture = npt.NDArray[Any]
Opened = dict[str, cv2.VideoCapture]


class Videos:
    """Frames of videos or live cameras.

    Args:
        files: camera name -> file or index of a device; or under the name ``""`` one that has all views.
        rig: its cameras say how views lie side by side.

    Raises:
        FileFormatError: OpenCV cannot open or decode one of them.
    """

    def __init__(self, files: Mapping[str, Path | int], rig: CameraRig) -> None:
        self.files, self.rig = dict(files), rig
        self._sampled: list[Frame] = []
        self.live = isinstance(next(iter(self.files.values())), int)
        with ExitStack() as stack:
            videos = self._open(stack)
            self.rate = next(iter(videos.values())).get(cv2.CAP_PROP_FPS) or 0.0
            counts = {name: int(video.get(cv2.CAP_PROP_FRAME_COUNT)) for name, video in videos.items()}
            self._sizes = {
                name: (int(video.get(cv2.CAP_PROP_FRAME_HEIGHT)), int(video.get(cv2.CAP_PROP_FRAME_WIDTH)))
                for name, video in videos.items()
            }
        fewest, most = min(counts.values()), max(counts.values())
        self.num_frames = None if self.live or fewest <= 0 else fewest
        if self.num_frames and fewest < most:
            listed = ", ".join(f"{name} {count}" for name, count in counts.items())
            warnings.warn(
                f"images: the videos have different numbers of frames ({listed}); "
                f"{most - fewest} that not all cameras have are left out",
                stacklevel=2,
            )

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Camera name -> (height, width) of its images."""
        if "" not in self._sizes:
            return self._sizes
        rows, columns = views_layout(self._sizes[""], self.rig)
        height, width = self._sizes[""]
        return dict.fromkeys(self.rig.names, (height // rows, width // columns))

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
        self, file: Path | int, number: int, selection: Selection, wanted: Callable[[str], bool]
    ) -> Iterator[Frame]:
        """Frames after the end of a video that its header promises, chosen and wanted; each says why it is not there.

        Containers whose headers count no frames tell how long they last, of which OpenCV makes a number. Matroska's
        tell their size as well: only what is shorter was cut. Of others the number may be off by a second.
        """
        promised = self.num_frames or 0
        if promised > number and not str(file).lower().endswith(COUNTED):
            cut = _is_cut(Path(str(file)))
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
        return split_views(rgb[""], self.rig) if "" in rgb else rgb

    def _open(self, stack: ExitStack) -> Opened:
        videos = {}
        for name, file in self.files.items():
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


def split_views(image: Picture, rig: CameraRig) -> dict[str, Picture]:
    """Cut a picture with the views of all cameras in rows and columns, in the order of the rig.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> views = split_views(np.zeros((16, 80, 3), np.uint8), ring_rig(4, image_size=(16, 20)))
        >>> list(views), views["cam4"].shape
        (['cam1', 'cam2', 'cam3', 'cam4'], (16, 20, 3))
    """
    rows, columns = views_layout((image.shape[0], image.shape[1]), rig)
    strips = [view for row in np.split(image, rows, 0) for view in np.split(row, columns, 1)]
    return dict(zip(rig.names, strips, strict=True))


def views_layout(size: Sequence[int], rig: CameraRig) -> tuple[int, int]:
    """Rows and columns in which n views fill a picture, told by the shape of the cameras' images.

    Raises:
        ArgumentError: no arrangement has views of that shape.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> views_layout((32, 40), ring_rig(4, image_size=(16, 20)))
        (2, 2)
    """
    number = len(rig)
    expected = {camera.image_size for camera in rig.cameras.values()}
    for rows in range(1, number + 1):
        columns = number // rows
        if rows * columns == number and size[0] % rows == 0 and size[1] % columns == 0:
            height, width = size[0] // rows, size[1] // columns
            if all(abs(height * w - width * h) <= 0.01 * height * w for h, w in expected):
                return rows, columns
    shapes = " or ".join(f"{width} x {height}" for height, width in sorted(expected))
    raise ArgumentError(
        f"images: a picture of {size[1]} x {size[0]} (width x height) does not hold {number} views of the shape "
        f"{shapes} in rows and columns"
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
