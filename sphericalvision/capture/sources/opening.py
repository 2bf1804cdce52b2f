# SPDX-License-Identifier: Apache-2.0
"""What ``images=`` may be: a pattern of images or videos, a folder, one video of all views, a bag, or live cameras."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch

from sphericalvision.cameras import CameraRig, PinholeCamera
from sphericalvision.cameras.calibration.parsing import errors_of_file
from sphericalvision.capture.sources.bags import JOIN, Bag, bag_of, is_part
from sphericalvision.capture.sources.bags import SUFFIXES as BAG_SUFFIXES
from sphericalvision.capture.sources.frames import Source
from sphericalvision.capture.sources.image_files import IMAGE_SUFFIXES, ImageFiles
from sphericalvision.capture.sources.joined_views import split_views
from sphericalvision.capture.sources.live import LiveCameras
from sphericalvision.capture.sources.patterns import EXAMPLE, files_of, find_files, find_labels
from sphericalvision.capture.sources.videos import VIDEO_SUFFIXES, Videos
from sphericalvision.core import ArgumentError, MissingFileError
from sphericalvision.io.images import read_mask
from sphericalvision.io.times import SAME_TIME

LAYOUTS = (
    "{camera}/{frame}",
    "cam{camera}/{frame}",
    "{camera}_{frame}",
    "cam{camera}_{frame}",
    "{frame}_{camera}",
    "{camera}/data/{frame}",
    "cam{camera}/data/{frame}",
    "image_{camera}/data/{frame}",
    "{camera}",
    "cam{camera}",
    "{frame}/{camera}",
)
"""How folders of captures name their files, most explicit first."""
RECTIFIED = re.compile(r"(?i)(?<![a-z])(rect|rectified|undist|undistorted)(?![a-z])")
"""In the name of images that a program has straightened."""
MASK_SAMPLES = 100
"""Pixels of the longer side of a mask that are looked at."""
LEAST_AHEAD = 0.01
"""Of the inner half of a field of view, usable."""


@dataclass(frozen=True)
class _Opening:
    """What is the same for everything that ``images`` may be."""

    rig: CameraRig
    used: CameraRig
    frames: Iterable[int | str] | None
    leave_out: Sequence[Path]
    tolerance: float
    labels: dict[str, str] = field(default_factory=dict)

    def source(self, images: str) -> Source:
        """The source of what is no folder, by its name."""
        path = Path(images).expanduser()
        is_video = path.suffix.lower() in VIDEO_SUFFIXES
        is_live, is_pattern = images.startswith("live:"), "{" in images
        bag = None if is_live or is_video else bag_of(path)
        if self.frames is not None and (is_live or is_video or bag is not None):
            raise ArgumentError(
                "frames: of videos, bags and live cameras choose frames with start=, stop= and every="
            )
        if is_live:
            return LiveCameras(_devices(images, self.used), self.used, self.rig)
        if bag is not None:
            return Bag(bag, self.used, self.rig, self.tolerance, self.labels)
        if is_video and not is_pattern:
            if not path.is_file():
                raise MissingFileError(
                    f"images: {path}: no such file (a video with the views of all cameras expected)"
                )
            return Videos({"": path}, self.used, self.rig, self.tolerance)
        if is_video:
            labels = self.labels_of(images)
            (files,) = find_files(images, self.used.names, labels=labels).frames.values()
            return _labelled(Videos(files, self.used, self.rig, self.tolerance), labels)
        if len(self.rig) > 1 and "{camera" not in images:
            return self._joined(images)
        labels = self.labels_of(images)
        moments = find_files(
            images, self.used.names, self.frames, self.leave_out, labels=labels, tolerance=self.tolerance
        )
        return _labelled(ImageFiles(moments, self.used, self.rig), labels)

    def labels_of(self, pattern: str) -> dict[str, str]:
        """What ``{camera}`` stands for in a pattern, by camera name."""
        unlabelled = [name for name in self.used.names if name not in self.labels]
        labels = self.labels | find_labels(pattern, self.rig.names, unlabelled, self.leave_out)
        labels = {name: labels[name] for name in self.used.names}
        if len(set(labels.values())) < len(labels):
            raise ArgumentError(f"cameras: expected files of its own for each camera, got {labels}")
        return labels

    def _joined(self, pattern: str) -> ImageFiles:
        """Pictures with the views of all cameras."""
        if "{" not in pattern and not Path(pattern).expanduser().is_file():
            raise ArgumentError(
                f"images: expected a pattern with {{camera}} and, if there are several frames, {{frame}}, such as "
                f"{EXAMPLE}, or pictures with the views of all cameras, got {pattern!r}"
            )
        source = ImageFiles(find_files(pattern, [""], self.frames, self.leave_out), self.used, self.rig)
        source.sizes()
        return source


def open_source(
    images: str,
    rig: CameraRig,
    frames: Iterable[int | str] | None = None,
    leave_out: Iterable[Path] = (),
    cameras: Sequence[str] | None = None,
    tolerance: float = SAME_TIME,
    labels: Mapping[str, str] | None = None,
) -> Source:
    """Find the frames that ``images`` stands for.

    Args:
        images: a pattern of image files (``c/cam{camera}/{frame:05d}.png``) or of videos (``c/{camera}.mp4``); a
            folder; a video with all views side by side or in a stream for each camera; stills (``c/{frame}.jpg``) with
            all views side by side; a bag of ROS (``run.bag``, or the folder of one of ROS 2); or ``live:0,1,2,3``,
            devices of this machine, or ``live:0``, one with all views.
        rig: all cameras of the calibration: which file belongs to which is decided on all of them.
        frames: names or numbers of the frames to use, of image files.
        leave_out: files that are no images, such as masks in the same folder.
        cameras: names of the cameras in use, in order; all when not given.
        tolerance: seconds between images of one moment, at most.
        labels: camera name -> what ``{camera}`` stands for, or the topic of a bag, where it is not to be found by name.

    Raises:
        ArgumentError: ``images`` is none of these, or may be several, or frames are named of a video.
        MissingFileError: there is nothing.
    """
    used = rig if cameras is None else rig.subset(list(cameras))
    opening = _Opening(rig, used, frames, list(leave_out), tolerance, dict(labels or {}))
    path = Path(images).expanduser()
    source = _of_folder(path, opening) if path.is_dir() and bag_of(path) is None else opening.source(images)
    files = next(iter(getattr(source, "moments", {"": {}}).values()))
    taken = [path, *getattr(source, "topics", files).values()]
    origins = ["/".join(file.parts[-3:]) if isinstance(file, Path) else str(file) for file in taken]
    straight = next((origin for origin in origins if RECTIFIED.search(origin)), None)
    if straight and not all(isinstance(camera, PinholeCamera) for camera in used.cameras.values()):
        warnings.warn(
            f"images: {straight} is called as images without distortion, and the calibration has one: take the "
            "images as they were taken, or a calibration of these",
            stacklevel=2,
        )
    return source


def _labelled(source: Source, labels: Mapping[str, str]) -> Source:
    """A source that says what ``{camera}`` stands for where it is not the cameras' names."""
    if any(name != label for name, label in labels.items()) and len(labels) > 1:
        source.labels = dict(labels)
    return source


def _of_folder(folder: Path, opening: _Opening) -> Source:
    """The one kind of files in a folder that every camera has."""
    excluded = {os.path.realpath(path) for path in opening.leave_out}
    files = [
        file
        for file in (*folder.glob("*"), *folder.glob("*/*"), *folder.glob("*/data/*"))
        if not file.name.startswith(".") and file.is_file() and os.path.realpath(file) not in excluded
    ]
    previews = {file for file in files if _is_preview(file)}
    for group in (set(files) - previews, previews):
        grouped = replace(opening, leave_out=[*opening.leave_out, *(set(files) - group)])
        if (pattern := _of_files(folder, group, grouped)) is None:
            continue
        source, suffix = grouped.source(pattern), Path(pattern).suffix
        labels = {*opening.rig.names, *getattr(source, "labels", {}).values()}
        taken = {file for label in labels for file in files_of(pattern, label).values()}
        folders = {file.parent for file in taken}
        rest = [
            str(file.relative_to(folder))
            for file in sorted(files)
            if file.parent in folders
            and file not in taken
            and file.suffix.lower() in (*IMAGE_SUFFIXES, *VIDEO_SUFFIXES)
        ]
        if rest:
            warnings.warn(
                f"images: {folder}: {suffix} is taken, and {len(rest)} previews or other files are left out "
                f"({', '.join(rest[:4])})",
                stacklevel=3,
            )
        return source
    found = sorted(files, reverse=True) or sorted(folder.glob("*/"))
    examples = {file.suffix or file.name: str(file.relative_to(folder)) for file in found}.values()
    raise MissingFileError(
        f"images: {folder} holds no images or videos of all {len(opening.rig)} cameras "
        f"({', '.join(opening.rig.names)}), called as {', '.join(LAYOUTS)} (videos without {{frame}}), but "
        f"{', '.join(examples) or 'no files'}. Give a pattern, such as images='{folder}/{{camera}}/{{frame}}.png' or "
        f"images='{folder}/{{camera}}/video.mp4'"
    )


def _is_preview(file: Path) -> bool:
    """Whether a camera wrote a video as a small copy of another, as GoPros and Insta360s do."""
    return file.suffix.lower() == ".lrv" or (
        file.name.startswith("LRV_") and file.suffix.lower() in VIDEO_SUFFIXES
    )


def _of_files(folder: Path, files: Iterable[Path], opening: _Opening) -> str | None:
    """The pattern of the one kind of files of which every camera has some; None without one."""
    suffixes = sorted({f.suffix for f in files if f.suffix.lower() in (*IMAGE_SUFFIXES, *VIDEO_SUFFIXES)})
    patterns = [pattern for suffix in suffixes for pattern in _layouts(folder, suffix, opening)]
    if not patterns:  # one video of all views, or pictures of them
        joined = sorted(
            file
            for file in files
            if file.parent == folder and file.suffix in suffixes and file.stem not in opening.rig.names
        )
        videos = [str(file) for file in joined if file.suffix.lower() in VIDEO_SUFFIXES]
        stills = {f"{folder}/{{frame}}{file.suffix}": None for file in joined if str(file) not in videos}
        patterns = [*videos, *stills]
    bags = [file for file in files if file.name.lower().endswith(BAG_SUFFIXES)]
    patterns += sorted({str(file.parent if is_part(file) else file) for file in bags})
    if len(patterns) > 1:
        raise ArgumentError(
            f"images: {folder} holds several kinds of files that may be meant: {', '.join(patterns[:4])}; name one of "
            f"them, such as images='{patterns[0]}'{f', or make one bag of them: {JOIN}' * bool(bags)}"
        )
    return patterns[0] if patterns else None


def _layouts(folder: Path, suffix: str, opening: _Opening) -> list[str]:
    """The layouts of which a folder has files of every camera, with this suffix; each of files or owners of its own."""
    matches: list[tuple[bool, str, dict[Path, str]]] = []
    is_video = suffix.lower() in VIDEO_SUFFIXES
    layouts = [layout for layout in LAYOUTS if not (is_video and "{frame}" in layout)]
    if len(opening.rig) == 1 and not is_video:
        layouts.insert(0, "{frame}")
    for layout in layouts:
        pattern = f"{folder}/{layout}{suffix}"
        try:
            labels = opening.labels_of(pattern)
        except MissingFileError:
            continue
        # 1.png to 4.png may be four cameras, or four pictures of all views: names alone tell.
        by_number = any(name != label for name, label in labels.items())
        if layout in ("{camera}", "{frame}/{camera}") and by_number:
            continue
        files = {file: name for name, label in labels.items() for file in files_of(pattern, label).values()}
        matches.append((by_number, pattern, files))
    # 0001/cam2.png is of cam2, not of cam1; of 1_1.png to 4_10.png all belong to four cameras, and 16 to four frames.
    matches.sort(key=lambda match: (match[0], -len(match[2])))
    kept: list[tuple[bool, str, dict[Path, str]]] = []
    for by_number, pattern, files in matches:
        if not any(
            files.keys() <= others.keys() and (not number or files.keys() < others.keys() or files == others)
            for number, _, others in kept
        ):
            kept.append((by_number, pattern, files))
    return [pattern for _, pattern, _ in kept]


def _devices(images: str, rig: CameraRig) -> dict[str, int]:
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
        masks: pattern of images with ``{camera}``; or one image with the masks of all, as their images lie side by
            side; white where usable.
        cameras: names of those that are used; all when not given.
    """
    names = rig.names if cameras is None else list(cameras)
    path = Path(masks).expanduser()
    if "{" not in masks and path.is_file() and len(rig) > 1:
        views = split_views(read_mask(path, what="a mask of all views"), rig)
        with errors_of_file(str(path)):
            masked = rig.replaced(masks={name: views[name].contiguous() for name in names})
        return _with_centers_seen(masked, names), [path]
    if "{camera}" not in masks or "{frame" in masks:
        raise ArgumentError(
            "masks: expected a pattern with {camera} only, such as 'capture/cam{camera}/mask.png', or one image with "
            f"the masks of all cameras, as their images lie side by side, got {masks!r}"
        )
    labels = find_labels(masks, rig.names, names, key="masks")
    (files,) = find_files(masks, names, key="masks", labels=labels).frames.values()
    usable = {
        name: read_mask(file, rig.cameras[name].image_size, f"the mask of camera {name}")
        for name, file in files.items()
    }
    return _with_centers_seen(rig.replaced(masks=usable), names), list(files.values())


def _with_centers_seen(rig: CameraRig, names: Sequence[str]) -> CameraRig:
    """The rig, with a warning where masks hide what cameras see ahead, as those do whose black is usable."""
    hiding = []
    for name in names:
        camera = rig.cameras[name]
        step = -(-max(camera.image_size) // MASK_SAMPLES)
        rays, valid = camera.unproject(camera.pixel_grid(torch.float32)[::step, ::step])
        angles = torch.atan2(rays[..., :2].norm(dim=-1), rays[..., 2])
        ahead = valid & (angles < camera.max_angle / 2)
        if bool(ahead.any()) and float(rig.masks[name][::step, ::step][ahead].float().mean()) < LEAST_AHEAD:
            hiding.append(name)
    if hiding:
        warnings.warn(
            f"masks: those of {', '.join(hiding)} hide what these cameras see ahead; masks are white where images are "
            "usable. Is black usable in these files?",
            stacklevel=3,
        )
    return rig
