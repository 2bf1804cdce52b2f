# SPDX-License-Identifier: Apache-2.0
"""Captures as commands name them: calibration, cameras and masks as one value, and what commands print of them."""

import dataclasses
import glob
import math
import re
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from annotated_types import Ge, MinLen
from pydantic.dataclasses import dataclass
from torch import Tensor

from sphericalvision.cameras import Camera, CameraRig, EquirectangularCamera
from sphericalvision.cameras.robot_frame import OPTICAL_FROM_ROS, read_pose
from sphericalvision.cameras.trajectory import upright_turn
from sphericalvision.capture.preparation.dark_surround import without_dark_surround
from sphericalvision.capture.sources.frames import Frame, Selection, Source, spread_evenly
from sphericalvision.capture.sources.image_files import IMAGE_SUFFIXES
from sphericalvision.capture.sources.moving import NAME, Moving
from sphericalvision.capture.sources.opening import open_source, rig_for_images, rig_with_masks
from sphericalvision.core import ArgumentError, FileFormatError
from sphericalvision.io.images import read_image_size, read_mask
from sphericalvision.io.times import SAME_TIME
from sphericalvision.recipes.app.kinds import (
    STRICT,
    Count,
    HalfAngle,
    Names,
    Number,
    OnlyWith,
    Positive,
    Size,
    Text,
    Unit,
)
from sphericalvision.recipes.app.rigs import Calibration, keys_named, names_of
from sphericalvision.sphere.intake import as_photographs

AUTO = "auto"
"""Masks in place of a pattern: those of the rig's own body, found in the frames."""
FIELD = re.compile(r"\{(camera|frame)[^{}]*\}")
"""Fields of a pattern; other braces are part of a name."""
FLOOR = "floor"
"""Up in place of an axis: away from the floor that the depth of the frames shows."""
PANORAMA = "equirectangular"
"""Calibration in place of a file: images are whole panoramas of any size."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Capture(Calibration):
    """The frames of a capture and its calibration.

    ``conf/predict.yaml`` explains its keys.
    """

    images: Text
    frames: Annotated[list[int | str], MinLen(1)] | None = None
    start: Number = 0
    stop: Count | None = None
    every: Count = 1
    cameras: Names | None = None
    masks: Text | None = None
    tolerance: Annotated[float, Ge(0)] = SAME_TIME

    @property
    def selection(self) -> Selection:
        """Which of the frames are taken, by position."""
        return Selection(self.start, self.stop, self.every)

    def open(self) -> Source:
        """The frames, with their rig, in the size of the images and with its masks on (``AUTO`` is none yet)."""
        rig = self.rig()
        cameras, labels = cameras_and_labels(self.cameras, rig)
        files: list[Path] = []
        if self.masks not in (None, AUTO):
            rig, files = rig_with_masks(rig, self.masks, cameras)
            whose = dict(zip(cameras or rig.names, (file.name for file in files), strict=False))
            if len(files) > 1 and not all(name in file for name, file in whose.items()):
                print("Masks: " + ", ".join(f"{name} is {file}" for name, file in whose.items()) + ".")
        elif rig.masks and self.masks is None:
            print(f"Masks: of {', '.join(rig.masks)}, which come with {self.calibration}.")
        source = open_source(self.images, rig, self.frames, files, cameras, self.tolerance, labels)
        rig = source.rig
        print_labels(source)
        sizes = source.sizes()
        source.rig = rig_for_images(rig, sizes)
        for name in rig.names:
            if source.rig.cameras[name].image_size != rig.cameras[name].image_size:
                (height, width), (h, w) = sizes[name], rig.cameras[name].image_size
                print(
                    f"Warning: images of {name} have {width} x {height} pixels (width x height), the calibration is "
                    f"for {w} x {h}. They are taken as the whole image resized; if they are a part of it, depth will "
                    "be wrong: crop the calibration, or capture at its size."
                )
                break
        return source

    def restrict(self, source: Source) -> None:
        """Mask the rig's own body where that is asked for, and let fields of view end where the images are dark.

        Raises:
            ArgumentError: live cameras, which cannot be read twice, are to be masked.
        """
        if self.masks == AUTO:
            if source.live:
                raise ArgumentError(
                    "masks: auto reads the frames before the first is predicted, which live cameras do not allow; "
                    "record some, predict with masks=auto, and give its masks: masks='.../masks/{camera}.png'"
                )
            from sphericalvision.capture.preparation.own_body import MOST

            frames = evenly_chosen(source, MOST)  # whichever are to be predicted
            images = (as_photographs(f.images, source.rig) for f in frames if f.images is not None)
            source.rig = with_own_body_masked(source.rig, images)
        cut_to_visible(source, self.max_angle_deg)

    def rig(self, dtype: torch.dtype | None = None) -> CameraRig:
        """The rig of the file, of a pattern with fields the folder above them; images say the size that it does not.

        What is there under its own name is no pattern.
        """
        path = self.calibration
        if (field := FIELD.search(path)) and not Path(path).exists():
            path = str(Path(path[: field.start()] + "_").parent)
        calibration = Calibration(path, self.translation_unit, self.max_angle_deg, self.image_size)
        try:
            return calibration.rig(dtype)
        except ArgumentError as error:
            size = None if self.image_size else size_of_images(self.images)
            if size is None or not str(error).startswith("image_size: "):
                raise
            return replace(calibration, image_size=size).rig(dtype)


@dataclasses.dataclass(eq=False, repr=False, kw_only=True)
class CaptureFields:
    """Keys of a capture that data modules have next to their own."""

    images: Text
    calibration: Text | None = None
    cameras: Names | None = None
    masks: Text | None = None
    translation_unit: Unit | None = None
    max_angle_deg: HalfAngle | None = None
    image_size: Size | None = None

    def capture_with(self, **keys: Any) -> Capture:
        """The capture of these keys, and of further ones."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(CaptureFields)}
        return Capture(**{**values, "calibration": self.calibration or self.images, **keys})


def size_of_images(pattern: str) -> tuple[int, int] | None:
    """Height and width of the images of a pattern; None where these are not all the same."""
    files = glob.glob("*".join(map(glob.escape, re.split(r"\{.*?\}", pattern))))
    sizes = {read_image_size(file) for file in files if Path(file).suffix.lower() in IMAGE_SUFFIXES}
    return sizes.pop() if len(sizes) == 1 else None


@dataclass(frozen=True, kw_only=True, config=STRICT)
class PosedCapture(Capture):
    """A capture that may have poses: of one camera that moves, or of a rig.

    ``conf/predict.yaml`` explains its keys.
    """

    poses: Text | None = None
    window: Annotated[int, Ge(2), OnlyWith("poses")] = 3
    spacing: Annotated[Positive | None, OnlyWith("poses")] = None
    up: Literal["-y", "y", "z", "camera", "floor"] | None = None
    frame: Text | None = None

    @property
    def upwards(self) -> str:
        """Direction that points up before a floor levels the rig: ``up``, or its default.

        Raises:
            ArgumentError: a robot's frame has another up, or a floor is to level what moves.
        """
        if self.up == FLOOR and (self.poses or self.frame):
            raise ArgumentError(
                "up: floor is for a rig without poses= and frame=, which say what points up; leave it out"
            )
        expected = ("z", "y", "-y") if self.poses else ("z",)
        if self.frame and self.up not in (None, *expected):
            raise ArgumentError(
                f"up: with frame, whose z points up, expected {' or '.join(expected)}, got {self.up}; leave it out"
            )
        return "-y" if self.up == FLOOR else self.up or ("z" if self.frame else "-y")

    def placement(self, rig: CameraRig) -> Tensor:
        """``(4, 4)``, from the frame of the calibration to that in which its rig is used: upright, or the poses'."""
        base = torch.eye(4) if self.frame is None else read_pose(self.frame, "frame")
        if self.poses is not None:  # which say what is up
            return base
        rotation = OPTICAL_FROM_ROS if self.frame else upright_turn(self.upwards, rig.world_from_camera)
        return rotation.to(base) @ base

    @property
    def axes(self) -> Tensor | None:
        """``(3, 3)``, from where depth is computed to axes of a robot's frame, or of its world; None without one."""
        if self.frame is None:
            return None
        rotation = OPTICAL_FROM_ROS if self.poses is None else upright_turn(self.upwards, torch.eye(4)[None])
        return rotation[:3, :3].mT

    def open(self) -> Source:
        """The frames; with poses those of windows, where ``calibration`` may be ``PANORAMA``.

        Raises:
            ArgumentError: one camera without poses, or with poses and a key that is for rigs.
        """
        if self.poses is None:
            if self._num_cameras() == 1:
                raise ArgumentError(
                    f"calibration: {self.calibration} is of one camera, and one camera alone has no depth: give "
                    "poses=, a file of where it was at each image (of TUM, KITTI or COLMAP), or the calibration of a "
                    "rig of two cameras or more, with their poses"
                )
            return super().open()
        from sphericalvision.cameras import read_trajectory

        trajectory = read_trajectory(self.poses).turned(self.upwards)
        cameras: dict[str, Camera] = {NAME: EquirectangularCamera((512, 1024))}
        if self.calibration != PANORAMA:
            cameras = self.camera_models()
        source = super().open() if len(cameras) > 1 else self._open_single(next(iter(cameras.values())))
        with keys_named(images="poses"):
            # Its rig follows from that of its source, and nobody sets it.
            return Moving(source, trajectory, self.window, self.spacing or 0.0)  # type: ignore[return-value]

    def _num_cameras(self) -> int | None:
        """Count the cameras of the calibration; None where it cannot be read."""
        if self.calibration == PANORAMA and not Path(PANORAMA).exists():
            return 1
        try:
            return len(self.camera_models())
        except (ArgumentError, FileFormatError, OSError):
            return None  # whoever opens it tells why

    def _open_single(self, camera: Camera) -> Source:
        """The images of one camera, with a mask on."""
        for key in ("cameras", "translation_unit"):
            if getattr(self, key) is not None:
                raise ArgumentError(f"{key}: with poses there is one camera, in metres; leave {key} out")
        if self.masks == AUTO:
            raise ArgumentError("masks: auto is for rigs; of one camera give an image, white where usable")
        files = [] if self.masks is None else [Path(self.masks)]
        single = CameraRig({NAME: camera}, torch.eye(4)[None])
        source = open_source(self.images, single, self.frames, files)
        single = rig_for_images(single, source.sizes())
        size = single.cameras[NAME].image_size
        masks = [read_mask(file, size, "the mask") for file in files]
        source.rig = single.replaced(masks=dict(zip([NAME], masks, strict=False)))
        return source


def cameras_and_labels(
    cameras: Sequence[str | int] | None, rig: CameraRig
) -> tuple[list[str] | None, dict[str, str]]:
    """Names of the cameras in use, and the labels of those that a configuration has as ``name:label``.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> cameras_and_labels(["cam2:/left/image_raw", "cam1"], ring_rig(2))
        (['cam2', 'cam1'], {'cam2': '/left/image_raw'})
    """
    if cameras is None:
        return None, {}
    names, labels = [], {}
    for entry in map(str, cameras):
        name, _, label = (entry, "", "") if entry in rig.cameras else entry.partition(":")
        names.append(name)
        if label:
            labels[name] = label
    return names_of(names, rig), labels


def print_labels(source: Source) -> None:
    """Print which files, streams or topics are whose, where their names do not say it, and how images were paired."""
    if source.labels:
        print("Images: " + ", ".join(f"{name} is {label}" for name, label in source.labels.items()) + ".")
    if source.pairing:
        print(f"Images: {source.pairing}.")


def recorded_names(source: Source, selection: Selection, where: str = "") -> list[str]:
    """Names of the selected frames of a rig's recording; ``where`` is what keys in messages begin with, ``"data."``.

    Raises:
        ArgumentError: live cameras, or one camera.
    """
    if len(source.rig) < 2:
        raise ArgumentError(f"{where}cameras: expected two or more that see the same things, got one")
    names = source.names(selection)
    if names is None:
        raise ArgumentError(f"{where}images: expected a recording, not live cameras")
    return names


def recorded_photographs(source: Source, names: Container[str]) -> Iterator[tuple[str, dict[str, Tensor]]]:
    """Name and images of each of some frames.

    Raises:
        FileFormatError: a frame cannot be read.
    """
    for frame in source.frames(Selection(), names.__contains__):
        if frame.images is None:
            raise frame.error or FileFormatError(f"images: could not read the images of frame {frame.name}")
        yield frame.name, as_photographs(frame.images, source.rig)


def evenly_chosen(source: Source, count: int) -> Iterator[Frame]:
    """Frames of a recording at even distances, ``count`` of them; of live cameras all."""
    names = source.names(Selection())
    chosen = None if names is None else set(spread_evenly(names, count))
    return source.frames(Selection(), lambda name: chosen is None or name in chosen)


def cut_to_visible(source: Source, max_angle_deg: float | None) -> None:
    """Let fields of view end where the images of a source are dark beyond, in up to three frames, and print so.

    Live cameras, and a rig whose ``max_angle_deg`` is given, stay as they are.
    """
    if max_angle_deg is not None or source.live:
        return
    frames = (as_photographs(f.images, source.rig) for f in source.samples() if f.images is not None)
    source.rig, angles = without_dark_surround(source.rig, frames)
    for name, angle in angles.items():
        print(
            f"Field of view: {name} is dark beyond {math.degrees(angle):.0f}° from its axis in all frames compared, "
            "and ends there; max_angle_deg= overrides this."
        )


def with_own_body_masked(rig: CameraRig, frames: Iterable[Mapping[str, Tensor]]) -> CameraRig:
    """The rig with masks of its own body; prints a line for each camera."""
    from sphericalvision.capture import find_own_body

    body = find_own_body(rig, frames)
    for line in body.described():
        print(line)
    return rig.replaced(masks=body.masks)
