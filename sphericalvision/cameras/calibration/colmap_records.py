# SPDX-License-Identifier: Apache-2.0
"""What COLMAP's text and binary files hold, as records that know where they stand; and the files made of records."""

from __future__ import annotations

import re
import struct
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from sphericalvision.cameras.calibration.lenses import PANORAMA, Lens
from sphericalvision.cameras.calibration.parsing import numbers
from sphericalvision.cameras.calibration.poses import transform_from_numbers
from sphericalvision.cameras.calibration.text_files import data_lines
from sphericalvision.core import FileFormatError
from sphericalvision.geometry import invert_transform
from sphericalvision.io.files import read_bytes, read_text

Record = TypeVar("Record")

LENSES = (
    Lens("SIMPLE_PINHOLE", "pinhole", "f cx cy"),
    Lens("PINHOLE", "pinhole", "fx fy cx cy"),
    Lens("SIMPLE_RADIAL", "brown_conrady", "f cx cy k1"),
    Lens("RADIAL", "brown_conrady", "f cx cy k1 k2"),
    Lens("OPENCV", "brown_conrady", "fx fy cx cy k1 k2 p1 p2"),
    Lens("OPENCV_FISHEYE", "kannala_brandt", "fx fy cx cy k1 k2 k3 k4"),
    Lens("FULL_OPENCV", "brown_conrady", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    Lens("FOV", "atan", "fx fy cx cy omega"),
    Lens("SIMPLE_RADIAL_FISHEYE", "kannala_brandt", "f cx cy k1", "k2 k3 k4"),
    Lens("RADIAL_FISHEYE", "kannala_brandt", "f cx cy k1 k2", "k3 k4"),
    Lens(
        "THIN_PRISM_FISHEYE",
        "thin_prism_fisheye",
        "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1=s1 sy1=s3",
        options={"composition": "additive"},
    ),
    Lens(
        "RAD_TAN_THIN_PRISM_FISHEYE",
        "thin_prism_fisheye",
        "fx fy cx cy k0=k1 k1=k2 k2=k3 k3=k4 k4=k5 k5=k6 p0=p2 p1 s0=s1 s1=s2 s2=s3 s3=s4",
        options={"composition": "sequential"},
    ),
    Lens("SIMPLE_DIVISION", "division", "f cx cy k=k1"),
    Lens("DIVISION", "division", "fx fy cx cy k=k1"),
    Lens("SIMPLE_FISHEYE", "fisheye", "f cx cy", options={"projection": "equidistant"}),
    Lens("FISHEYE", "fisheye", "fx fy cx cy", options={"projection": "equidistant"}),
    Lens("EUCM", "extended_unified", "fx fy cx cy alpha beta"),
    Lens("EQUIRECTANGULAR", "equirectangular", "w h", options=PANORAMA.options),
)
"""In the order of their numbers in binary files. Of one class that which holds most of a camera is written."""
FORKED = 11
"""From this number on programs made from COLMAP have models of their own."""
_SENSOR_TYPES = ("CAMERA", "IMU")
_IDENTITY = [1.0, 0, 0, 0, 0, 0, 0]


class CameraRecord(NamedTuple):
    """A camera of ``cameras.*``."""

    where: str
    id: int
    lens: Lens
    size: Sequence[Any]
    """Width, height."""
    parameters: list[float]


class ImageRecord(NamedTuple):
    """An image of ``images.*``; what was seen on it is written, and not read."""

    where: str
    id: int
    pose: list[float]
    """qw qx qy qz tx ty tz, world to camera."""
    camera: int
    name: str
    pixels: npt.NDArray[Any] = np.zeros((0, 2))
    """``(k, 2)`` of the points that it shows."""
    points: npt.NDArray[Any] = np.zeros(0, np.int64)
    """``(k,)`` rows of these points in ``PointRecords``; point 0 has the id 1."""


class PointRecords(NamedTuple):
    """Points of ``points3D.*``; images say which of them they show."""

    positions: npt.NDArray[Any] = np.zeros((0, 3))
    colors: npt.NDArray[Any] = np.zeros((0, 3), np.uint8)

    def tracks(self, images: Sequence[ImageRecord]) -> list[npt.NDArray[Any]]:
        """Of each point ``(k, 2)``: ids of the images that show it, and its places among their points."""
        sightings = [
            np.stack((np.full(len(image.points), image.id), np.arange(len(image.points))), -1)
            for image in images
        ]
        points = np.concatenate([image.points for image in images])
        order = np.argsort(points, kind="stable")
        ends = np.searchsorted(points[order], np.arange(1, len(self.positions)))
        return np.split(np.concatenate(sightings)[order], ends)[: len(self.positions)]


class SensorRecord(NamedTuple):
    """A sensor of a rig."""

    type: str
    id: int
    pose: list[float] | None
    """qw qx qy qz tx ty tz, rig to sensor; None if it is not known."""


class FrameRecord(NamedTuple):
    """A moment of ``frames.*``: where a rig was, and the images that it took."""

    where: str
    rig: int
    pose: list[float]
    """qw qx qy qz tx ty tz, world to rig."""
    images: dict[int, tuple[str, int]]
    """Id of an image -> type and id of the sensor that took it."""


class RigRecord(NamedTuple):
    """A rig of ``rigs.*``; its frame is that of its reference sensor."""

    where: str
    id: int
    sensors: list[SensorRecord]
    """The reference sensor first."""


def cameras_in(path: Path) -> list[CameraRecord]:
    """Of ``cameras.txt`` or ``cameras.bin``."""
    return _records(path, _text_camera, _binary_camera)


def images_in(path: Path) -> list[ImageRecord]:
    """Of ``images.txt`` or ``images.bin``, whose poses agree with ``frames`` and ``rigs`` next to them.

    COLMAP 4 keeps poses twice and uses those of the frames; a version of it left old ones in ``images``.
    """
    images = _Bytes(path).records(_binary_image) if path.suffix == ".bin" else _text_images(path)
    frames, rigs = (path.with_name(f"{name}{path.suffix}") for name in ("frames", "rigs"))
    if frames.is_file() and rigs.is_file():
        _check_frames(images, _records(frames, _text_frame, _binary_frame), rigs_in(rigs))
    return images


def _check_frames(images: list[ImageRecord], frames: list[FrameRecord], rigs: list[RigRecord]) -> None:
    sensor_from_rig = {
        (rig.id, sensor.type, sensor.id): transform_of(sensor.pose, rig.where)
        for rig in rigs
        for sensor in rig.sensors
        if sensor.pose is not None
    }
    by_id = {image.id: image for image in images}
    for frame in frames:
        rig_from_world = transform_of(frame.pose, frame.where)
        for id, sensor in frame.images.items():
            image, offset = by_id.get(id), sensor_from_rig.get((frame.rig, *sensor))
            if image is not None and image.camera != sensor[1]:
                raise FileFormatError(
                    f"{image.where}: {image.name!r:.80} is of camera {image.camera}, and of camera {sensor[1]} in its "
                    f"frame ({frame.where}); keep the right one"
                )
            if image is None or offset is None:  # not an image, or the sensor's place is not known
                continue
            expected, stated = offset @ rig_from_world, transform_of(image.pose, image.where)
            if not torch.allclose(expected, stated, rtol=1e-5, atol=1e-4):
                distance = (invert_transform(expected) - invert_transform(stated))[:3, 3].norm()
                raise FileFormatError(
                    f"{image.where}: the pose of {image.name!r:.80} is not the one that its frame has ({frame.where}); "
                    f"the positions are {distance:.3g} apart. COLMAP uses the frames: let it write the model again "
                    "(colmap model_converter), or delete frames and rigs if the images are right"
                )


def transform_of(pose: list[float], where: str) -> Tensor:
    """The rigid transform (4, 4) of a quaternion and a translation."""
    return transform_from_numbers(pose[:4], pose[4:], where)


def _text_images(path: Path) -> list[ImageRecord]:
    """Lines come in pairs, the second of which may be empty."""
    lines = [
        (number, line)
        for number, line in enumerate(read_text(path).splitlines(), start=1)
        if not line.lstrip().startswith("#")
    ]
    while lines and not lines[0][1].strip():
        lines.pop(0)
    for number, line in lines[1::2]:
        if line.count(" ") and (len(line.split()) % 3 or re.search(r"[^-+.\deE\s]", line)):
            raise FileFormatError(
                f"{path}, line {number}: expected the points of the image above, X Y POINT3D_ID each, or an empty "
                f"line, got {line.strip()!r:.80}"
            )
    images = []
    for number, line in lines[::2]:
        entries = line.split(maxsplit=9)
        if not entries:
            continue
        where = f"{path}, line {number}"
        if len(entries) < 10:
            raise FileFormatError(
                f"{where}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got {line.strip()!r:.80}"
            )
        image, camera = _ids([entries[0], entries[8]], where)
        images.append(ImageRecord(where, image, _pose(entries[1:8], where), camera, entries[9].strip()))
    return _counted(path, images)


def rigs_in(path: Path) -> list[RigRecord]:
    """Of ``rigs.txt`` or ``rigs.bin``."""
    return _records(path, _text_rig, _binary_rig)


def _records(
    path: Path, of_line: Callable[[list[str], str], Record], of_bytes: Callable[[_Bytes], Record]
) -> list[Record]:
    """Of a text with one a line, or of a binary file."""
    if path.suffix == ".bin":
        return _Bytes(path).records(of_bytes)
    return _counted(path, [of_line(words, f"{path}, line {line}") for line, words in data_lines(path)])


def _counted(path: Path, records: list[Record]) -> list[Record]:
    """The records of a text, with a warning where its head counts others."""
    count = re.search(rf"(?m)^# Number of {re.escape(path.stem)}: (\d+)", read_text(path))
    if count and int(count[1]) != len(records):
        said = f"{path}: its head says {count[1]} {path.stem}, there are {len(records)}; is it cut short?"
        warnings.warn(said, stacklevel=6)
    return records


def _text_camera(words: list[str], where: str) -> CameraRecord:
    if len(words) < 4:
        raise FileFormatError(
            f"{where}: expected CAMERA_ID MODEL WIDTH HEIGHT and parameters, got {' '.join(words)}"
        )
    if not re.fullmatch(r"\d{1,18}", words[0]):
        raise FileFormatError(f"{where}: expected a camera number of its own first, got {words[0]!r}")
    lenses = {lens.name: lens for lens in LENSES}
    if words[1] not in lenses:
        raise FileFormatError(f"{where}: expected a model among {', '.join(lenses)}, got {words[1]}")
    lens = lenses[words[1]]
    parameters = numbers(words[4:], f"{where}, {lens.name} ({' '.join(lens.keys)})", len(lens.keys))
    return CameraRecord(where, int(words[0]), lens, words[2:4], parameters)


def _text_rig(words: list[str], where: str) -> RigRecord:
    def take(count: int, what: str) -> list[str]:
        if len(words) < count:
            raise FileFormatError(f"{where}: expected {what}, the line is too short; is it cut off?")
        taken, words[:count] = words[:count], []
        return taken

    rig, count = _ids(take(2, "RIG_ID NUM_SENSORS"), where)
    sensors: list[SensorRecord] = []
    for index in range(min(count, len(words))):
        type, id = take(2, "SENSOR_TYPE SENSOR_ID")
        pose = None if index else _IDENTITY
        if index and take(1, "HAS_POSE")[0] == "1":
            pose = _pose(take(7, "QW QX QY QZ TX TY TZ"), where)
        if type not in _SENSOR_TYPES:
            raise FileFormatError(f"{where}: expected {' or '.join(_SENSOR_TYPES)}, got {type!r}")
        sensors.append(SensorRecord(type, _ids([id], where)[0], pose))
    if count < 1 or len(sensors) < count or words:
        raise FileFormatError(
            f"{where}: announces {count} sensors and has {len(sensors)} and {len(words)} words more; is it cut off?"
        )
    return RigRecord(where, rig, sensors)


def _text_frame(words: list[str], where: str) -> FrameRecord:
    if len(words) < 10 or not words[9].isdecimal() or len(words) != 10 + 3 * int(words[9]):
        raise FileFormatError(
            f"{where}: expected FRAME_ID RIG_ID QW QX QY QZ TX TY TZ NUM_DATA_IDS and three words for each of these "
            f"(SENSOR_TYPE SENSOR_ID DATA_ID), got {len(words)} words; is it cut off?"
        )
    types, sensors, images = words[10::3], _ids(words[11::3], where), _ids(words[12::3], where)
    rig, pose = _ids(words[1:2], where)[0], _pose(words[2:9], where)
    return FrameRecord(where, rig, pose, _sensors(types, sensors, images))


def _sensors(types: Sequence[str], sensors: Sequence[int], data: Sequence[int]) -> dict[int, tuple[str, int]]:
    """Images by id; data of other sensors are numbered apart."""
    entries = zip(types, sensors, data, strict=True)
    return {image: (type, sensor) for type, sensor, image in entries if type == "CAMERA"}


def _pose(values: list[Any], where: str) -> list[float]:
    return numbers(values, f"{where}, QW QX QY QZ TX TY TZ", 7)


def _ids(words: list[str], where: str) -> list[int]:
    if not all(re.fullmatch(r"\d{1,18}", word) for word in words):
        raise FileFormatError(f"{where}: expected whole numbers, got {' '.join(words)}")
    return [int(word) for word in words]


class _Bytes:
    """A binary file, read from the front."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.at = path, read_bytes(path), 0

    @property
    def where(self) -> str:
        return f"{self.path}, byte {self.at}"

    def take(self, kinds: str) -> tuple[Any, ...]:
        """Little-endian numbers of these kinds."""
        size = struct.calcsize(f"<{kinds}")
        if self.at + size > len(self.data):
            raise FileFormatError(f"{self.where}: the file ends here; is it truncated?")
        self.at += size
        return struct.unpack_from(f"<{kinds}", self.data, self.at - size)

    def skip(self, size: int) -> None:
        """Leave so many bytes out."""
        if self.at + size > len(self.data):
            raise FileFormatError(f"{self.where}: {size} bytes are expected here; is it truncated?")
        self.at += size

    def word(self) -> str:
        """A text that ends with a zero."""
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise FileFormatError(f"{self.where}: a name without an end; is it truncated?")
        text, self.at = self.data[self.at : end], end + 1
        try:
            return text.decode("utf-8")
        except UnicodeDecodeError:
            raise FileFormatError(f"{self.where}: expected the name of an image") from None

    def records(self, record: Callable[[_Bytes], Record]) -> list[Record]:
        """All records of a file that begins with their number."""
        records = [record(self) for _ in range(self.take("Q")[0])]
        if self.at != len(self.data):
            raise FileFormatError(f"{self.where}: {len(self.data) - self.at} bytes more than announced")
        return records


def _binary_camera(file: _Bytes) -> CameraRecord:
    where = file.where
    id, model, width, height = file.take("IiQQ")
    if not 0 <= model < len(LENSES):
        raise FileFormatError(f"{where}: expected a model from 0 to {len(LENSES) - 1}, got {model}")
    lens, count = LENSES[model], len(LENSES[model].keys)
    if model >= FORKED and len(file.data) - file.at < 8 * count:
        raise FileFormatError(
            f"{where}: model {model} is COLMAP's {lens.name} of {count} numbers, for which the file is too short. "
            "Forks give other models this number, SphereSfM its SPHERE of three; export the model as text there, "
            "and call a panorama EQUIRECTANGULAR w h"
        )
    parameters = numbers(file.take(f"{count}d"), f"{where}, {lens.name} ({' '.join(lens.keys)})")
    return CameraRecord(where, id, lens, (width, height), parameters)


def _binary_image(file: _Bytes) -> ImageRecord:
    where = file.where
    image, *pose, camera = file.take("I7dI")
    name = file.word()
    file.skip(24 * file.take("Q")[0])
    return ImageRecord(where, image, _pose(pose, where), camera, name)


def _binary_rig(file: _Bytes) -> RigRecord:
    where = file.where
    rig, count = file.take("II")
    if count < 1:
        raise FileFormatError(f"{where}: expected at least one sensor, got none")
    sensors = [SensorRecord(*_binary_sensor(file), _IDENTITY)]
    for _ in range(count - 1):
        type, id = _binary_sensor(file)
        has_pose = file.take("B")[0]
        pose = _pose(list(file.take("7d")), where) if has_pose else None
        sensors.append(SensorRecord(type, id, pose))
    return RigRecord(where, rig, sensors)


def _binary_frame(file: _Bytes) -> FrameRecord:
    where = file.where
    _, rig, *pose, count = file.take("II7dI")
    entries = [(*_binary_sensor(file), *file.take("Q")) for _ in range(count)]
    types, sensors, images = zip(*entries, strict=True) if entries else ((), (), ())
    return FrameRecord(where, rig, _pose(pose, where), _sensors(types, sensors, images))


def _binary_sensor(file: _Bytes) -> tuple[str, int]:
    where = file.where
    type, id = file.take("iI")
    if not 0 <= type < len(_SENSOR_TYPES):
        raise FileFormatError(f"{where}: expected a sensor of type 0 or 1, got {type}")
    return _SENSOR_TYPES[type], id


def _frames(images: list[ImageRecord], rig: RigRecord) -> list[list[ImageRecord]]:
    """Images by frames, in each of which a rig has taken one with each of its cameras, in order."""
    size = len(rig.sensors)
    return [images[first : first + size] for first in range(0, len(images), size)]


def text_files(
    cameras: list[CameraRecord], images: list[ImageRecord], rigs: list[RigRecord], points: PointRecords
) -> dict[str, bytes]:
    """The files of a model by name; images come frame by frame, in which the one rig took one with each camera."""
    lines: dict[str, list[str]] = {
        "cameras": ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"],
        "images": ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME; X Y POINT3D_ID[]"],
        "rigs": ["# RIG_ID NUM_SENSORS REF_SENSOR_TYPE REF_SENSOR_ID SENSORS[]"],
        "frames": ["# FRAME_ID RIG_ID RIG_FROM_WORLD[] NUM_DATA_IDS DATA_IDS[]"],
        "points3D": ["# POINT3D_ID X Y Z R G B ERROR TRACK[] as IMAGE_ID POINT2D_IDX"],
    }
    for camera in cameras:
        lines["cameras"].append(_joined(camera.id, camera.lens.name, *camera.size, *camera.parameters))
    for image in images:
        pairs = zip(image.pixels.tolist(), image.points.tolist(), strict=True)
        line = " ".join(f"{u:.3f} {v:.3f} {point + 1}" for (u, v), point in pairs)
        lines["images"] += [_joined(image.id, *image.pose, image.camera, image.name), line]
    for rig in rigs:
        first, *others = rig.sensors
        poses = [word for sensor in others for word in (sensor.type, sensor.id, 1, *(sensor.pose or []))]
        lines["rigs"].append(_joined(rig.id, len(rig.sensors), first.type, first.id, *poses))
        for number, frame in enumerate(_frames(images, rig), start=1):
            data = [word for image in frame for word in ("CAMERA", image.camera, image.id)]
            lines["frames"].append(_joined(number, rig.id, *frame[0].pose, len(frame), *data))
    if not images:
        lines = {"cameras": lines["cameras"]}
    else:
        rows = zip(*points, points.tracks(images), strict=True)
        for number, parts in enumerate(rows, start=1):
            position, color, track = (part.ravel().tolist() for part in parts)
            lines["points3D"].append(_joined(number, *position, *color, 0, *track))
    return {f"{name}.txt": ("\n".join(text) + "\n").encode() for name, text in lines.items()}


def _joined(*words: object) -> str:
    return " ".join(repr(word) if isinstance(word, float) else str(word) for word in words)


def binary_files(
    cameras: list[CameraRecord], images: list[ImageRecord], rigs: list[RigRecord], points: PointRecords
) -> dict[str, bytes]:
    """The same in binary."""
    chunks = [struct.pack("<Q", len(cameras))]
    for camera in cameras:
        chunks.append(struct.pack("<IiQQ", camera.id, LENSES.index(camera.lens), *camera.size))
        chunks.append(struct.pack(f"<{len(camera.parameters)}d", *camera.parameters))
    files = {"cameras.bin": b"".join(chunks)}
    if not images:
        return files
    chunks = [struct.pack("<Q", len(images))]
    for image in images:
        sightings = np.empty(len(image.points), [("pixel", "<f8", 2), ("point", "<u8")])
        sightings["pixel"], sightings["point"] = image.pixels, image.points + 1
        chunks.append(struct.pack("<I7dI", image.id, *image.pose, image.camera))
        chunks.append(image.name.encode() + b"\0" + struct.pack("<Q", len(sightings)) + sightings.tobytes())
    files["images.bin"] = b"".join(chunks)
    chunks = [struct.pack("<Q", len(rigs))]
    grouped = [(rig, frame) for rig in rigs for frame in _frames(images, rig)]
    frames = [struct.pack("<Q", len(grouped))]
    for rig in rigs:
        first, *others = rig.sensors
        chunks.append(struct.pack("<IIiI", rig.id, len(rig.sensors), 0, first.id))
        chunks += [struct.pack("<iIB7d", 0, sensor.id, 1, *(sensor.pose or [])) for sensor in others]
    for number, (rig, frame) in enumerate(grouped, start=1):
        frames.append(struct.pack("<II7dI", number, rig.id, *frame[0].pose, len(frame)))
        frames += [struct.pack("<iIQ", 0, image.camera, image.id) for image in frame]
    rows = [struct.pack("<Q", len(points.positions))]
    for number, (position, color, track) in enumerate(zip(*points, points.tracks(images), strict=True), 1):
        rows.append(struct.pack("<Q3d3BdQ", number, *position, *color, 0.0, len(track)))
        rows.append(track.astype("<u4").tobytes())
    return files | {
        "rigs.bin": b"".join(chunks),
        "frames.bin": b"".join(frames),
        "points3D.bin": b"".join(rows),
    }
