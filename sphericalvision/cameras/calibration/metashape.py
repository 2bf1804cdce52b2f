# SPDX-License-Identifier: Apache-2.0
"""Agisoft Metashape's XML: a calibration alone, or the cameras of a chunk with poses.

Convention:
    ``cx`` and ``cy`` are offsets from the middle of the image, in whose pixels the first centre is (0.5, 0.5): half a
    pixel is taken off. ``p1`` and ``p2`` are OpenCV's p2 and p1. ``b1`` is fx − fy. ``type`` is ``frame``, ``fisheye``
    (the terms of a frame camera act on the equidistant image) or ``spherical``.

    A camera's ``transform`` takes its coordinates (x right, y down, z forward) to the chunk's, in its unit times
    ``scale``, if there is one.

References:
    Agisoft Metashape User Manual, Professional Edition, appendix "Camera models".
"""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import torch

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Contents, Options
from sphericalvision.cameras.calibration.files import parse_xml, read_text
from sphericalvision.cameras.calibration.formats import FileFormat, register_format
from sphericalvision.cameras.calibration.lenses import Lens
from sphericalvision.cameras.calibration.parsing import (
    numbers,
    size_from_width_height,
)
from sphericalvision.cameras.calibration.poses import transform_from_rows
from sphericalvision.cameras.calibration.visible_part import bounded
from sphericalvision.cameras.models.equirectangular import EquirectangularCamera
from sphericalvision.core import FileFormatError

__all__ = ["contents", "recognizes"]

_TYPES = ("frame", "fisheye", "spherical")
_KEYS = ("f", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2", "b1", "b2")
_PLAIN = Lens("frame", "pinhole", "f+b1=fx f=fy cx cy")
_FRAME = Lens("frame", "brown_conrady", "f+b1=fx f=fy cx cy k1 k2 k3 p1=p2 p2=p1")
_FISHEYE = Lens(
    "fisheye",
    "thin_prism_fisheye",
    "f+b1=fx f=fy cx cy k1 k2 k3 p1=p2 p2=p1 k4",
    options={"composition": "additive"},
)


def recognizes(path: Path) -> bool:
    """Whether an XML begins with <calibration>, or with a <document> that has a <chunk>."""
    if path.suffix.lower() != ".xml":
        return False
    text = read_text(path)
    first = re.search(r"<(\w+)", text)  # neither <?xml ...?> nor <!-- ... --> begins with a letter
    return first is not None and (first[1] == "calibration" or (first[1] == "document" and "<chunk" in text))


def contents(path: Path, options: Options) -> Contents:
    """The calibration of a file, or the sensors of a chunk; the chunk's cameras by label if poses are wanted."""
    text = read_text(path)
    root = parse_xml(text, path)
    if root.tag == "calibration":
        return Contents({path.stem: _camera(root, str(path), options)})
    chunk = root.find("chunk")
    if chunk is None:
        raise FileFormatError(f"{path}: expected <calibration>, or a <chunk> in <document>, got <{root.tag}>")
    sensors: dict[str, Camera] = {}
    for sensor in chunk.iterfind("sensors/sensor"):
        where = f"{path}, sensor {sensor.get('id')}"
        found = sensor.findall("calibration")
        if found:  # the adjusted one stands last
            sensors[str(sensor.get("id"))] = _camera(found[-1], where, options, sensor)
    if not sensors:
        raise FileFormatError(f"{path}: no sensor with a calibration in it")
    if not options.rig:
        return Contents({f"cam{name}": camera for name, camera in sensors.items()})
    return _of_cameras(chunk, sensors, path)


def _of_cameras(chunk: ElementTree.Element, sensors: dict[str, Camera], path: Path) -> Contents:
    scale = chunk.find("transform/scale")
    factor = 1.0 if scale is None else numbers((scale.text or "").split(), f"{path}, scale", 1)[0]
    cameras: dict[str, Camera] = {}
    poses = []
    for camera in chunk.iterfind(".//camera"):
        transform, sensor = camera.find("transform"), str(camera.get("sensor_id"))
        name = str(camera.get("label") or camera.get("id"))
        where = f"{path}, camera {name!r:.80}"
        if transform is None:
            continue  # was not aligned
        if name in cameras or sensor not in sensors:
            raise FileFormatError(
                f"{where}: expected a label of its own and a sensor of {', '.join(sensors)}"
            )
        pose = transform_from_rows((transform.text or "").split(), f"{where}, transform")
        pose[:3, 3] *= factor
        cameras[name] = sensors[sensor]
        poses.append(pose)
    if not cameras:
        raise FileFormatError(f"{path}: no camera in it has a transform")
    return Contents(cameras, torch.stack(poses))


def _camera(
    element: ElementTree.Element, where: str, options: Options, sensor: ElementTree.Element | None = None
) -> Camera:
    def get(key: str) -> float:
        found = element.find(key)
        return 0.0 if found is None else numbers((found.text or "").split(), f"{where}, {key}", 1)[0]

    projection = element.find("projection")
    named = element.get("type") or (projection.text if projection is not None else None)
    kind = (named or (sensor.get("type") if sensor is not None else None) or "frame").strip()
    if kind not in _TYPES:
        raise FileFormatError(f"{where}, type: expected {' or '.join(_TYPES)}, got {kind!r:.80}")
    resolution = element.find("resolution")
    if resolution is None and sensor is not None:
        resolution = sensor.find("resolution")
    sides = [get("width"), get("height")]
    if resolution is not None:
        sides = [resolution.get("width"), resolution.get("height")]  # type: ignore[list-item]
    size = size_from_width_height(sides, f"{where}, width and height")
    if kind == "spherical":
        return EquirectangularCamera(size)
    f, cx, cy, k1, k2, k3, k4, p1, p2, b1, b2 = (get(key) for key in _KEYS)
    if (kind == "fisheye" and b2) or (kind == "frame" and k4):
        raise FileFormatError(
            f"{where}: b2 (skew) of a fisheye, and k4 of a frame camera, have no place in a camera here, got "
            f"b2 = {b2:g} and k4 = {k4:g}; calibrate without them"
        )
    found = [f + b1, f, size[1] / 2 + cx - 0.5, size[0] / 2 + cy - 0.5, k1, k2, k3, p1, p2]
    if kind == "fisheye":
        camera = _FISHEYE.camera([*found, k4], size, where)
    else:
        lens = _FRAME if any(found[4:]) else _PLAIN
        camera = lens.camera(found, size, where, skew=b2 or None)
    return bounded(camera, options.max_angle, where)


register_format(
    FileFormat("metashape", "Metashape xml", recognizes_file=recognizes, contents_of_file=contents)
)
