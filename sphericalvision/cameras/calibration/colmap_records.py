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
from sphericalvision.cameras.calibration.parsing import chosen, numbers
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
_IDENTITY = [1.0, 0, 0, 0, 0, 0, 0]
_POSE = "QW QX QY QZ TX TY TZ"
_CHOICES = {"L": tuple(lens.name for lens in LENSES), "T": ("CAMERA", "IMU")}
"""Kinds of values beside those of ``struct``, of lenses and sensors: words in a text, numbers in a binary file."""
_NUMBERS = str.maketrans(dict.fromkeys(_CHOICES, "i"))


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
    return _records(path, _camera)


def images_in(path: Path) -> list[ImageRecord]:
    """Of ``images.txt`` or ``images.bin``, whose poses agree with ``frames`` and ``rigs`` next to them.

    COLMAP 4 keeps poses twice and uses those of the frames; a version of it left old ones in ``images``.
    """
    images = _Bytes(path).records(_image) if path.suffix == ".bin" else _text_images(path)
    frames, rigs = (path.with_name(f"{name}{path.suffix}") for name in ("frames", "rigs"))
    if frames.is_file() and rigs.is_file():
        _check_frames(images, _records(frames, _frame), rigs_in(rigs))
    return images


def rigs_in(path: Path) -> list[RigRecord]:
    """Of ``rigs.txt`` or ``rigs.bin``."""
    return _records(path, _rig)


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
        if line.strip():
            images.append(_image(_Line(line.strip().split(maxsplit=9), f"{path}, line {number}")))
    return _counted(path, images)


def _records(path: Path, record: Callable[[_Line | _Bytes], Record]) -> list[Record]:
    """Of a text with one a line, or of a binary file."""
    if path.suffix == ".bin":
        return _Bytes(path).records(record)
    lines = [_Line(words, f"{path}, line {line}") for line, words in data_lines(path)]
    return _counted(path, [record(line) for line in lines])


def _counted(path: Path, records: list[Record]) -> list[Record]:
    """The records of a text, with a warning where its head counts others."""
    count = re.search(rf"(?m)^# Number of {re.escape(path.stem)}: (\d+)", read_text(path))
    if count and int(count[1]) != len(records):
        said = f"{path}: its head says {count[1]} {path.stem}, there are {len(records)}; is it cut short?"
        warnings.warn(said, stacklevel=6)
    return records


def _camera(source: _Line | _Bytes) -> CameraRecord:
    where = source.where
    id, model, width, height = source.take("ILQQ", "CAMERA_ID MODEL WIDTH HEIGHT")
    lens, count = LENSES[model], len(LENSES[model].keys)
    if model >= FORKED and isinstance(source, _Bytes) and len(source.data) - source.at < 8 * count:
        raise FileFormatError(
            f"{where}: model {model} is COLMAP's {lens.name} of {count} numbers, for which the file is too short. "
            "Forks give other models this number, SphereSfM its SPHERE of three; export the model as text there, "
            "and call a panorama EQUIRECTANGULAR w h"
        )
    parameters = source.take("d" * count, " ".join(lens.keys))
    source.end()
    return CameraRecord(where, id, lens, (width, height), parameters)


def _image(source: _Line | _Bytes) -> ImageRecord:
    where = source.where
    image, *pose, camera = source.take("IdddddddI", f"IMAGE_ID {_POSE} CAMERA_ID")
    return ImageRecord(where, image, pose, camera, source.name())


def _rig(source: _Line | _Bytes) -> RigRecord:
    where = source.where
    rig, count = source.take("II", "RIG_ID NUM_SENSORS")
    if count < 1:
        raise FileFormatError(f"{where}: expected at least one sensor, got none")
    sensors = [SensorRecord(*_sensor(source), _IDENTITY)]
    for _ in range(count - 1):
        type, id = _sensor(source)
        (has_pose,) = source.take("B", "HAS_POSE")
        sensors.append(SensorRecord(type, id, source.take("ddddddd", _POSE) if has_pose else None))
    source.end()
    return RigRecord(where, rig, sensors)


def _frame(source: _Line | _Bytes) -> FrameRecord:
    where = source.where
    _, rig, *pose, count = source.take("IIdddddddI", f"FRAME_ID RIG_ID {_POSE} NUM_DATA_IDS")
    images = {}
    for _ in range(count):
        sensor, (data,) = _sensor(source), source.take("Q", "DATA_ID")
        if sensor[0] == "CAMERA":  # data of other sensors are numbered apart
            images[data] = sensor
    source.end()
    return FrameRecord(where, rig, pose, images)


def _sensor(source: _Line | _Bytes) -> tuple[str, int]:
    type, id = source.take("TI", "SENSOR_TYPE SENSOR_ID")
    return _CHOICES["T"][type], id


class _Line:
    """A record in a text: its words, which are taken one after the other."""

    def __init__(self, words: list[str], where: str) -> None:
        self.words, self.where = words, where

    def take(self, kinds: str, names: str) -> list[Any]:
        """The next numbers, of these kinds and names."""
        if len(self.words) < len(kinds):
            raise FileFormatError(f"{self.where}: expected {names}, the line is too short; is it cut off?")
        words, self.words = self.words[: len(kinds)], self.words[len(kinds) :]
        return [
            self._number(kind, word, f"{self.where}, {name}")
            for kind, word, name in zip(kinds, words, names.split(), strict=True)
        ]

    @staticmethod
    def _number(kind: str, word: str, where: str) -> float:
        if kind == "d":
            return numbers(word, where)[0]
        if kind in _CHOICES:
            return _CHOICES[kind].index(chosen(word, _CHOICES[kind], where))
        if not re.fullmatch(r"\d{1,18}", word):
            raise FileFormatError(f"{where}: expected a whole number, got {word!r:.80}")
        return int(word)

    def name(self) -> str:
        """Of an image, with which the line ends."""
        if not self.words:
            raise FileFormatError(f"{self.where}: expected NAME, the line is too short; is it cut off?")
        return self.words.pop()

    def end(self) -> None:
        """Refuse words behind the record."""
        if self.words:
            raise FileFormatError(
                f"{self.where}: has {len(self.words)} words more than it announces, {' '.join(self.words)!r:.80}"
            )


class _Bytes:
    """A binary file of records, read from the front."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.at = path, read_bytes(path), 0

    @property
    def where(self) -> str:
        return f"{self.path}, byte {self.at}"

    def take(self, kinds: str, names: str) -> list[Any]:
        """The next numbers, of these kinds and names, little-endian."""
        layout, where = f"<{kinds.translate(_NUMBERS)}", self.where
        self.skip(struct.calcsize(layout))
        values = struct.unpack_from(layout, self.data, self.at - struct.calcsize(layout))
        for kind, value, name in zip(kinds, values, names.split(), strict=True):
            if kind == "d":
                numbers(value, f"{where}, {name}")
            elif kind in _CHOICES and not 0 <= value < len(_CHOICES[kind]):
                most = len(_CHOICES[kind]) - 1
                raise FileFormatError(f"{where}, {name}: expected a number from 0 to {most}, got {value}")
        return list(values)

    def skip(self, size: int) -> None:
        """Leave so many bytes out."""
        if self.at + size > len(self.data):
            raise FileFormatError(f"{self.where}: {size} bytes are expected here; is it truncated?")
        self.at += size

    def name(self) -> str:
        """A text that ends with a zero; the points of the image, which follow it, are left out."""
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise FileFormatError(f"{self.where}: a name without an end; is it truncated?")
        text, self.at = self.data[self.at : end], end + 1
        self.skip(24 * self.take("Q", "NUM_POINTS2D")[0])
        try:
            return text.decode("utf-8")
        except UnicodeDecodeError:
            raise FileFormatError(f"{self.where}: expected the name of an image") from None

    def end(self) -> None:
        """Another record may follow."""

    def records(self, record: Callable[[_Bytes], Record]) -> list[Record]:
        """All records of a file that begins with their number."""
        records = [record(self) for _ in range(self.take("Q", "NUM")[0])]
        if self.at != len(self.data):
            raise FileFormatError(f"{self.where}: {len(self.data) - self.at} bytes more than announced")
        return records


Fields = list[tuple[str, Sequence[Any]]]
"""A record to be written: kinds and values of one group of fields after the other."""


def model_files(
    cameras: list[CameraRecord],
    suffix: str,
    images: Sequence[ImageRecord] = (),
    rig: RigRecord | None = None,
    points: PointRecords = PointRecords(),  # noqa: B008
) -> dict[str, bytes]:
    """The files of a model by name, in text (``.txt``) or binary (``.bin``).

    Images come frame by frame, in which the rig took one with each of its cameras, in order.
    """
    heads = {"cameras": "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"}
    records: dict[str, list[Fields]] = {"cameras": [_camera_fields(camera) for camera in cameras]}
    if rig is not None:
        size = len(rig.sensors)
        frames = [images[first : first + size] for first in range(0, len(images), size)]
        rows = zip(*points, points.tracks(images), strict=True)
        heads["images"] = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME; X Y POINT3D_ID[]"
        records["images"] = [_image_fields(image) for image in images]
        heads["rigs"] = "RIG_ID NUM_SENSORS REF_SENSOR_TYPE REF_SENSOR_ID SENSORS[]"
        records["rigs"] = [_rig_fields(rig)]
        heads["frames"] = "FRAME_ID RIG_ID RIG_FROM_WORLD[] NUM_DATA_IDS DATA_IDS[]"
        records["frames"] = [_frame_fields(number, rig.id, each) for number, each in enumerate(frames, 1)]
        heads["points3D"] = "POINT3D_ID X Y Z R G B ERROR TRACK[] as IMAGE_ID POINT2D_IDX"
        records["points3D"] = [_point_fields(number, *row) for number, row in enumerate(rows, 1)]
    if suffix == ".bin":
        return {f"{name}.bin": _binary(each) for name, each in records.items()}
    return {f"{name}.txt": _text(heads[name], each) for name, each in records.items()}


def _camera_fields(camera: CameraRecord) -> Fields:
    first = [camera.id, LENSES.index(camera.lens), *camera.size]
    return [("ILQQ", first), ("d" * len(camera.parameters), camera.parameters)]


def _image_fields(image: ImageRecord) -> Fields:
    sightings = np.empty(len(image.points), [("pixel", "<f8", 2), ("point", "<u8")])
    sightings["pixel"], sightings["point"] = image.pixels, image.points + 1
    numbered = [image.id, *image.pose, image.camera]
    return [("IdddddddI", numbered), ("name", [image.name]), ("sightings", [sightings])]


def _rig_fields(rig: RigRecord) -> Fields:
    first, *others = rig.sensors
    fields: Fields = [("IITI", [rig.id, len(rig.sensors), 0, first.id])]
    return fields + [("TIBddddddd", [0, sensor.id, 1, *(sensor.pose or [])]) for sensor in others]


def _frame_fields(number: int, rig: int, images: Sequence[ImageRecord]) -> Fields:
    fields: Fields = [("IIdddddddI", [number, rig, *images[0].pose, len(images)])]
    return fields + [("TIQ", [0, image.camera, image.id]) for image in images]


def _point_fields(number: int, *columns: npt.NDArray[Any]) -> Fields:
    position, color, track = (column.ravel().tolist() for column in columns)
    return [
        ("QdddBBBd", [number, *position, *color, 0]),
        ("count", [len(track) // 2]),
        ("I" * len(track), track),
    ]


def _text(head: str, records: list[Fields]) -> bytes:
    lines = [f"# {head}"]
    for record in records:
        words: list[str] = []
        for kinds, values in record:
            if kinds == "sightings":
                lines.append(" ".join(words))
                words = [f"{u:.3f} {v:.3f} {point}" for (u, v), point in values[0].tolist()]
            elif kinds == "name":
                words += values
            elif kinds != "count":  # which a text leaves out
                words += [
                    _CHOICES[kind][value] if kind in _CHOICES else repr(value)
                    for kind, value in zip(kinds, values, strict=True)
                ]
        lines.append(" ".join(words))
    return ("\n".join(lines) + "\n").encode()


def _binary(records: list[Fields]) -> bytes:
    chunks = [struct.pack("<Q", len(records))]
    for kinds, values in (field for record in records for field in record):
        if kinds == "name":
            chunks.append(values[0].encode() + b"\0")
        elif kinds == "sightings":
            chunks += [struct.pack("<Q", len(values[0])), values[0].tobytes()]
        else:
            chunks.append(struct.pack("<Q" if kinds == "count" else f"<{kinds.translate(_NUMBERS)}", *values))
    return b"".join(chunks)
