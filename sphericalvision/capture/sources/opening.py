# SPDX-License-Identifier: Apache-2.0
"""What ``images=`` may be: a pattern of images or videos, a folder, one video of all views, a bag, or live cameras."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from sphericalvision.cameras import CameraRig
from sphericalvision.capture.sources.bags import Bag, bag_of
from sphericalvision.capture.sources.frames import Files, Source, find_capture, find_labels, find_masks
from sphericalvision.capture.sources.videos import VIDEO_SUFFIXES, Videos
from sphericalvision.core import ArgumentError, MissingFileError
from sphericalvision.io.images import read_mask
from sphericalvision.io.times import SAME_TIME

__all__ = ["open_source", "rig_for_images", "rig_with_masks", "spread_evenly"]

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
STEMS = (
    "{camera}/{frame}",
    "cam{camera}/{frame}",
    "{camera}_{frame}",
    "cam{camera}_{frame}",
    "{camera}",
    "cam{camera}",
)
"""How folders of captures are laid out, most explicit first."""
ALONE = ("{frame}",)
"""How folders of one camera are laid out first of all."""


def open_source(
    images: str,
    rig: CameraRig,
    frames: Iterable[int | str] | None = None,
    leave_out: Iterable[Path] = (),
    cameras: Sequence[str] | None = None,
    tolerance: float = SAME_TIME,
) -> Source:
    """Find the frames that ``images`` stands for.

    Args:
        images: a pattern of image files (``c/cam{camera}/{frame:05d}.png``) or of videos (``c/{camera}.mp4``); a
            folder; a video with all views side by side or in a stream for each camera; stills (``c/{frame}.jpg``) with
            all views side by side; a bag of ROS (``run.bag``, or the folder of one of ROS 2); or ``live:0,1,2,3``,
            devices of this machine, or ``live:0``, one with all views.
        rig: all cameras of the calibration: which file belongs to which is decided on all of them.
        frames: names or numbers of the frames to take, of image files.
        leave_out: files that are no images, such as masks beside them.
        cameras: names of those that are used, in order; all when not given.
        tolerance: seconds between images of one frame, as ``find_capture`` has it.

    Raises:
        ArgumentError: ``images`` is none of these, or frames are named of a video.
        MissingFileError: there is nothing.
    """
    used = rig if cameras is None else rig.subset(list(cameras))
    if images.startswith("live:"):
        _refuse_frames(frames)
        return Videos(_devices(images, used), used, rig)
    path = Path(images).expanduser()
    suffix = path.suffix.lower()
    if suffix in VIDEO_SUFFIXES:
        _refuse_frames(frames)
        if "{" not in images:
            if not path.is_file():
                raise MissingFileError(
                    f"images: {path}: no such file (a video with the views of all cameras expected)"
                )
            return Videos({"": path}, used, rig)
        labels = find_labels(images, rig.names, used.names)
        (files,) = find_capture(images, used.names, labels=labels).values()
        return _announced(Videos(files, used, rig), labels)
    bag = bag_of(path) if "{" not in images else None
    if bag is not None:
        _refuse_frames(frames)
        return Bag(bag, used, rig, tolerance)
    if path.is_dir():
        return _of_folder(path, rig, frames, leave_out, used, tolerance)
    if len(rig) > 1 and "{camera" not in images:
        return _stills(images, rig, frames, leave_out, used)
    labels = find_labels(images, rig.names, used.names, leave_out)
    return _announced(
        Files(
            find_capture(images, used.names, frames, leave_out, labels=labels, tolerance=tolerance), used, rig
        ),
        labels,
    )


def _announced(source: Source, labels: Mapping[str, str]) -> Source:
    """A source that says what ``{camera}`` stands for where it is not the cameras' names."""
    if any(name != label for name, label in labels.items()) and len(labels) > 1:
        source.labels = dict(labels)
    return source


def _stills(
    pattern: str,
    rig: CameraRig,
    frames: Iterable[int | str] | None,
    leave_out: Iterable[Path],
    used: CameraRig,
) -> Files:
    """Pictures that hold the views of all cameras.

    Raises:
        ArgumentError: the first picture does not hold so many views.
    """
    if "{" not in pattern and not Path(pattern).expanduser().is_file():
        raise ArgumentError(
            f"images: expected a pattern with {{camera}} and, if there are several frames, {{frame}}, such as "
            f"'capture/cam{{camera}}/{{frame:05d}}.png', or pictures with the views of all cameras, got {pattern!r}"
        )
    pictures = find_capture(pattern, ["all"], frames, leave_out)
    source = Files({name: {"": files["all"]} for name, files in pictures.items()}, used, rig)
    source.sizes()
    return source


def _of_folder(
    folder: Path,
    rig: CameraRig,
    frames: Iterable[int | str] | None,
    leave_out: Iterable[Path],
    used: CameraRig,
    tolerance: float,
) -> Source:
    """The first layout for which there are files of every camera."""
    files = (file for file in (*folder.glob("*"), *folder.glob("*/*")) if not file.name.startswith("."))
    suffixes = sorted({file.suffix for file in files if file.is_file()})
    excluded = list(leave_out)
    wrong: Exception | None = None  # of the first layout that there is
    for suffix in suffixes:
        if suffix.lower() in VIDEO_SUFFIXES:
            alone = [file for file in folder.glob(f"[!.]*{suffix}") if file.is_file()]
            stems = [stem for stem in STEMS if "{frame}" not in stem]
            for stem in stems:
                try:
                    return open_source(f"{folder}/{stem}{suffix}", rig, frames, cameras=used.names)
                except MissingFileError:
                    continue
            if len(alone) == 1:
                return open_source(str(alone[0]), rig, frames, cameras=used.names)
        elif suffix.lower() in IMAGE_SUFFIXES:
            for stem in (*ALONE[: len(rig) == 1], *STEMS, *ALONE[: len(rig) > 1]):
                try:
                    return open_source(
                        f"{folder}/{stem}{suffix}", rig, frames, excluded, used.names, tolerance
                    )
                except (MissingFileError, ArgumentError) as error:
                    if wrong is None and _is_layout(f"{folder}/{stem}{suffix}", rig, used, excluded):
                        wrong = error
    if wrong is not None:
        raise wrong
    raise MissingFileError(
        f"images: {folder} holds no images or videos of all {len(rig)} cameras ({', '.join(rig.names)}); tried "
        f"{', '.join(STEMS)} with the suffixes {', '.join(suffixes) or '(no files)'}. Give a pattern, "
        f"images='{folder}/cam{{camera}}/{{frame}}.png'"
    )


def _is_layout(pattern: str, rig: CameraRig, used: CameraRig, leave_out: Iterable[Path]) -> bool:
    """Whether a pattern with ``{camera}`` has files of every camera, or of cameras of which it is not clear."""
    try:
        find_labels(pattern, rig.names, used.names, leave_out)
    except MissingFileError:
        return False
    except ArgumentError:
        return "{camera}" in pattern
    return True


def _devices(images: str, rig: CameraRig) -> dict[str, Path | int]:
    match = re.fullmatch(r"live:(\d+(?:,\d+)*)", images)
    numbers = [int(number) for number in match[1].split(",")] if match else []
    if len(numbers) == 1 < len(rig):
        return {"": numbers[0]}
    if len(numbers) != len(rig):
        raise ArgumentError(
            f"images: expected live:0 for one device that has all views, or {len(rig)} devices in the order of "
            f"{', '.join(rig.names)}, such as live:{','.join(map(str, range(len(rig))))}, got {images!r}"
        )
    return dict(zip(rig.names, numbers, strict=True))


def _refuse_frames(frames: Iterable[int | str] | None) -> None:
    if frames is not None:
        raise ArgumentError(
            "frames: of videos, bags and live cameras choose frames with start=, stop= and every="
        )


def rig_for_images(rig: CameraRig, sizes: dict[str, tuple[int, int]]) -> CameraRig:
    """The rig for images of other sizes than calibrated, where they have the same shape; else the rig as it is."""
    other = {}
    for name, (height, width) in sizes.items():
        h, w = rig.cameras[name].image_size
        if (height, width) != (h, w) and abs(height * w - width * h) <= 0.005 * height * w:
            other[name] = (height, width)
    return rig.resized(other) if other else rig


def rig_with_masks(
    rig: CameraRig, masks: str, cameras: Sequence[str] | None = None
) -> tuple[CameraRig, list[Path]]:
    """The rig with masks on, and their files.

    Args:
        rig: of all cameras.
        masks: pattern of images, white where usable.
        cameras: names of those that are used; all when not given.
    """
    files = find_masks(masks, rig.names, cameras)
    usable = {
        name: read_mask(path, rig.cameras[name].image_size, f"the mask of camera {name}")
        for name, path in files.items()
    }
    return rig.replaced(masks=usable), list(files.values())


def spread_evenly(names: list[str], number: int) -> list[str]:
    """So many names, from the first to the last.

    Examples:
        >>> spread_evenly(list("abcdefg"), 3)
        ['a', 'd', 'g']
    """
    if len(names) <= number:
        return names
    return [names[round(place * (len(names) - 1) / max(number - 1, 1))] for place in range(number)]
