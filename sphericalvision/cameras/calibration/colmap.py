# SPDX-License-Identifier: Apache-2.0
"""COLMAP's models, text and binary: ``cameras``, with poses from ``rigs`` or ``images`` beside them.

Convention:
    In COLMAP the centre of the top-left pixel is (0.5, 0.5), here it is (0, 0): half a pixel is taken off principal
    points in reading, and added in writing. Camera 1 is called ``cam1``.

    Poses are world to camera, as a unit quaternion (w, x, y, z) and a translation; a rig's are rig to sensor, its frame
    being that of the reference sensor. Lengths are in the model's own unit. As a rig, a model is the rig of several
    cameras that ``rigs`` has, or else its images: one camera each, called by the name of the image without suffix.

References:
    https://colmap.github.io/cameras.html, https://colmap.github.io/format.html
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from torch import Tensor

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.colmap_records import (
    LENSES,
    CameraRecord,
    ImageRecord,
    PointRecords,
    RigRecord,
    SensorRecord,
    cameras_in,
    images_in,
    model_files,
    rigs_in,
    transform_of,
)
from sphericalvision.cameras.calibration.contents import Calibration
from sphericalvision.cameras.calibration.formats import FileFormat
from sphericalvision.cameras.calibration.lenses import PANORAMA, lens_of, models_of, numbers_of
from sphericalvision.cameras.calibration.parsing import size_from_width_height, view_name
from sphericalvision.cameras.calibration.poses import quaternion_from_rotation
from sphericalvision.cameras.calibration.text_files import data_lines, looks_structured
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import ArgumentError, FileFormatError, check_file
from sphericalvision.geometry import invert_transform
from sphericalvision.io.files import write_bytes

_PARTS = ("cameras", "rigs", "images", "frames")
_BY_NAME = (*(f"{part}.bin" for part in _PARTS), "rigs.txt", "images.txt", "frames.txt")


def recognizes(path: Path) -> bool:
    """Whether it is called like a part of a model, or begins with a number and the name of a lens in capitals."""
    if path.name in _BY_NAME:
        return True
    if path.suffix == ".bin" or looks_structured(path):
        return False
    lines = data_lines(path)
    return bool(lines) and len(lines[0][1]) > 1 and bool(re.fullmatch(r"[A-Z][A-Z_0-9]+", lines[0][1][1]))


def read(path: Path, calibration: Calibration) -> None:
    """The cameras of a model; with poses if the file is ``rigs`` or ``images``, or if poses are wanted and there.

    Raises:
        FileFormatError: a record is broken, or its model is not known; the message names line or byte.
        MissingFileError: ``cameras`` is not beside the file.
    """
    file_type = path.stem if path.name in _BY_NAME else "cameras"
    if file_type == "frames":
        raise FileFormatError(
            f"{path}: holds poses of rigs; read the folder, rigs{path.suffix} or images{path.suffix}"
        )
    paths = {name: path.with_name(f"{name}{path.suffix}") for name in _PARTS}
    file = path if file_type == "cameras" else check_file(paths["cameras"], f"the cameras of {path.name}")
    if file_type == "cameras" and calibration.options.rig:
        rigs = rigs_in(paths["rigs"]) if paths["rigs"].is_file() else []
        if any(len(rig.sensors) > 1 for rig in rigs):
            file_type = "rigs"
        elif paths["images"].is_file():
            file_type = "images"
    lenses = calibration if file_type == "cameras" else Calibration(calibration.options, file)
    for record in cameras_in(file):
        lenses.add(f"cam{record.id}", _camera(record), record.where)
    if file_type == "rigs":
        _add_rig(rigs_in(paths["rigs"]), lenses.cameras, paths["rigs"], calibration)
    elif file_type == "images":
        _add_images(images_in(paths["images"]), lenses.cameras, paths["images"], calibration)


def _add_rig(
    rigs: list[RigRecord], cameras: Mapping[str, Camera], path: Path, calibration: Calibration
) -> None:
    several = [rig for rig in rigs if len(rig.sensors) > 1]
    if len(several) != 1:
        raise FileFormatError(
            f"{path}: expected one rig of several cameras, got {len(several)}; the poses of images are in "
            f"images{path.suffix}"
        )
    rig = several[0]
    for sensor in rig.sensors:
        name = f"cam{sensor.id}"
        if sensor.type != "CAMERA":
            continue
        if name not in cameras:
            raise FileFormatError(f"{rig.where}: expected a number of a camera, got {sensor.id}")
        if sensor.pose is None:
            raise FileFormatError(f"{rig.where}: camera {sensor.id} has no pose in the rig")
        pose = invert_transform(transform_of(sensor.pose, rig.where))
        calibration.add(name, cameras[name], rig.where, pose)


def _add_images(
    images: list[ImageRecord], cameras: Mapping[str, Camera], path: Path, calibration: Calibration
) -> None:
    for image in images:
        name, camera = view_name(image.name), cameras.get(f"cam{image.camera}")
        if not name:
            raise FileFormatError(f"{image.where}: expected an image with a name, got {image.name!r}")
        if camera is None:
            raise FileFormatError(
                f"{image.where}: there is no camera {image.camera} in cameras{path.suffix}; it has {', '.join(cameras)}"
            )
        pose = invert_transform(transform_of(image.pose, image.where))
        calibration.add(name, camera, image.where, pose)


def _camera(record: CameraRecord) -> Camera:
    where, numbers = record.where, record.parameters
    size = size_from_width_height(list(record.size), f"{where}, width and height")
    if record.lens.model == PANORAMA.model:
        if [size[1], size[0]] != numbers:
            raise FileFormatError(f"{where}, w and h: expected the image's width and height, got {numbers}")
        return PANORAMA.camera([], size, where)
    return record.lens.camera(record.lens.shifted(numbers, -0.5), size, where)


def write_colmap(cameras: Camera | Mapping[str, Camera], path: str | Path) -> None:
    """Write one camera or several as ``cameras.txt``, or in binary where ``path`` ends in ``.bin``.

    ``cam7`` becomes camera 7, other names are numbered from 1. Fields of view are not part of the format.
    """
    named = cameras if isinstance(cameras, Mapping) else {"cam1": cameras}
    if not named:
        raise ArgumentError("cameras: expected at least one camera, got none")
    path = Path(path)
    (content,) = model_files(_records(named), ".bin" if path.suffix == ".bin" else ".txt").values()
    write_bytes(path, content)


def write_colmap_rig(rig: CameraRig, path: str | Path) -> None:
    """Write a model into a folder: cameras, the rig, and one frame of it with an image ``<name>.png`` for each camera.

    In text; in binary if ``path`` is not the folder but ``cameras.bin`` in it. The first camera becomes the reference
    sensor; poses in the world are those of the images. Fields of view and masks are not part of the format.
    """
    path = Path(path)
    is_file = path.suffix in (".bin", ".txt")
    write_colmap_model(
        {"": rig}, path.parent if is_file else path, suffixes=[path.suffix if is_file else ".txt"]
    )


def write_colmap_model(
    frames: Mapping[str, CameraRig],
    folder: Path,
    points: PointRecords = PointRecords(),  # noqa: B008
    sightings: Mapping[str, tuple[npt.NDArray[Any], npt.NDArray[Any]]] | None = None,
    suffixes: Sequence[str] = (".txt", ".bin"),
) -> None:
    """Write a model of one rig at several moments.

    Args:
        frames: by name, the rig where it was then, with the same cameras; image ``<camera>/<frame>.png`` is of such
            a frame, or ``<camera>.png`` where the frame's name is empty.
        folder: of the files, ``sparse/0`` for most programs.
        points: of the scene.
        sightings: by name of the image without suffix, pixels ``(k, 2)`` of ours, and the rows of the points there.
        suffixes: in which forms.
    """
    first = next(iter(frames.values()))
    cameras = _records(first.cameras)
    from_first = (
        first.camera_from_world.detach().cpu().double() @ first.world_from_camera[0].detach().cpu().double()
    )
    images: list[ImageRecord] = []
    for frame, rig in frames.items():
        for name, camera, pose in zip(rig.names, cameras, rig.camera_from_world, strict=True):
            image = f"{name}/{frame}" if frame else name
            pixels, rows = (sightings or {}).get(image, (np.zeros((0, 2)), np.zeros(0, np.int64)))
            record = ImageRecord(
                "", len(images) + 1, _pose(pose), camera.id, f"{image}.png", pixels + 0.5, rows
            )
            images.append(record)
    sensors = [
        SensorRecord("CAMERA", camera.id, _pose(pose))
        for camera, pose in zip(cameras, from_first, strict=True)
    ]
    for suffix in suffixes:
        files = model_files(cameras, suffix, images, RigRecord("", 1, sensors), points)
        for name, content in files.items():
            write_bytes(folder / name, content)


def _pose(transform: Tensor) -> list[float]:
    return [*quaternion_from_rotation(transform[:3, :3]), *numbers_of(transform[:3, 3])]


def _records(named: Mapping[str, Camera]) -> list[CameraRecord]:
    all_numbered = all(re.fullmatch(r"cam\d+", name) for name in named)
    return [
        _record(int(name[3:]) if all_numbered else place, camera)
        for place, (name, camera) in enumerate(named.items(), start=1)
    ]


def _record(id: int, camera: Camera) -> CameraRecord:
    height, width = camera.image_size
    lens, numbers = lens_of(camera, LENSES, "colmap")
    is_panorama = lens.model == PANORAMA.model
    numbers = [float(width), float(height)] if is_panorama else lens.shifted(numbers, 0.5)
    return CameraRecord("", id, lens, (width, height), numbers)


FileFormat(
    "colmap",
    "COLMAP cameras, rigs and images (.txt, .bin)",
    recognizes_file=recognizes,
    read_file=read,
    usual_names=("cameras.bin", "cameras.txt"),
    models=models_of(LENSES),
    write_camera=write_colmap,
    write_rig=write_colmap_rig,
).register()
