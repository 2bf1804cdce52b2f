# SPDX-License-Identifier: Apache-2.0
"""Agisoft Metashape's XML: a calibration alone, or the cameras of a chunk with poses.

Convention:
    ``cx`` and ``cy`` are offsets from the middle of the image, in whose pixels the first centre is (0.5, 0.5): half a
    pixel is taken off. ``p1`` and ``p2`` are OpenCV's p2 and p1. ``b1`` is fx − fy. ``type`` is ``frame``, ``fisheye``
    or ``equidistant_fisheye`` (the terms of a frame camera act on the equidistant image), ``equisolid_fisheye`` or
    ``spherical``.

    A camera's ``transform`` takes its coordinates (x right, y down, z forward) to those of its component, or of the
    chunk, in the unit of which ``scale`` is the metres. A camera with a ``master_id`` has the pose of that camera times
    the one of its own sensor, which is ``rotation`` and ``location`` in the master's coordinates
    and in the same unit.

References:
    Agisoft Metashape User Manual, Professional Edition, appendix "Camera models".
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Calibration, warn_left_out
from sphericalvision.cameras.calibration.formats import FileFormat
from sphericalvision.cameras.calibration.keys import Keys
from sphericalvision.cameras.calibration.lenses import Lens
from sphericalvision.cameras.calibration.parsing import chosen, numbers, size_from_width_height, view_name
from sphericalvision.cameras.calibration.poses import transform_from_rotation, transform_from_rows
from sphericalvision.cameras.models.equirectangular import EquirectangularCamera
from sphericalvision.core import FileFormatError

_TYPES = ("frame", "fisheye", "equidistant_fisheye", "equisolid_fisheye", "spherical")
_KEYS = ("f", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4", "b1", "b2")
_PLAIN = Lens("frame", "pinhole", "f+b1=fx f=fy cx cy")
_FRAME = Lens("frame", "brown_conrady", "f+b1=fx f=fy cx cy k1 k2 k3 p1=p2 p2=p1")
_FISHEYE = Lens(
    "fisheye",
    "thin_prism_fisheye",
    "f+b1=fx f=fy cx cy k1 k2 k3 p1=p2 p2=p1 k4",
    options={"composition": "additive"},
)
_EQUISOLID = Lens("equisolid", "fisheye", "f+b1=fx f=fy cx cy", options={"projection": "equisolid"})
_IGNORED = (
    r"document/(version|chunk/[^/]+)|.*/next_(group_)?id|.*/active_id|.*/(enabled|class|label|locked)|.*/transform/(rotation"
    r"|translation)|.*/sensor/(property|bands|data_type|pixel_\w+|focal_length|layer_index|black_level|sensitivity|fixed\w*|photo_params|antenna"
    r"|normalize_\w+|vignetting|rolling_shutter(_mode)?|reference|meta|master_id|(rotation|location)/fixed)|.*/component/(region|partition)"
    r"|.*/group/\w+|.*/camera/(reference|vignetting|meta|layer_index|used|selected|component_id)"
)
"""Of sensors, cameras and components what is no camera and no pose; all else of the chunk."""


def recognizes(content: dict[str, Any]) -> bool:
    """Whether the root is <calibration>, or a <document> that has a <chunk>."""
    document = content.get("document")
    return isinstance(content.get("calibration"), dict) or (
        isinstance(document, dict) and "chunk" in document
    )


def read(content: Keys, calibration: Calibration) -> None:
    """The calibration of a file, or the sensors of a chunk; the chunk's cameras by label if poses are wanted."""
    if "calibration" in content:
        camera = _camera(content.inner("calibration"), Keys(), content.where)
        calibration.add(calibration.path.stem, camera, content.where)
        return
    chunk = content.inner("document").inner("chunk")
    wants_poses = calibration.options.rig
    sensors = Calibration(calibration.options, calibration.path) if wants_poses else calibration
    offsets: dict[str, torch.Tensor] = {}
    for sensor in _each(chunk.get("sensors"), "sensor"):
        name = f"cam{sensor.get('id')}"
        where = f"{content.where}, sensor {sensor.get('id')!s:.80}"
        # The adjusted one counts, wherever it stands; of several, and where none is called so, the last.
        calibrations = sorted(_each(sensor, "calibration"), key=lambda own: own.get("class") == "adjusted")
        if calibrations:
            sensor["calibration"] = calibrations[-1:]
            sensors.add(name, _camera(calibrations[-1], sensor, where), where)
        elif str(sensor.get("type")).strip() == "spherical":  # a panorama has nothing to calibrate
            sensors.add(name, _camera(Keys(sensor.where), sensor, where), where)
        else:  # of images that were not aligned; ``_add_cameras`` refuses one that was
            sensor.clear()
        offset = [sensor.get(key) for key in ("rotation", "location")]
        if any(
            value.get("text") if isinstance(value, Keys) else value for value in offset
        ):  # others are empty
            turn, place = (_floats(sensor.entry(key), f"{where}, {key}") for key in ("rotation", "location"))
            offsets[name] = transform_from_rotation(turn, place, f"{where}, rotation and location")
    if not sensors.cameras:
        raise FileFormatError(f"{content.where}: no sensor with a calibration in it")
    if wants_poses:
        _add_cameras(chunk, sensors.cameras, offsets, calibration)


def _each(values: Any, key: str) -> Iterator[Keys]:
    """The elements of a name, of which there may be one or several."""
    elements = values.get(key, []) if isinstance(values, Keys) else []
    yield from (
        value for value in (elements if isinstance(elements, list) else [elements]) if isinstance(value, Keys)
    )


def _floats(value: Any, where: str, count: int | None = None) -> list[float]:
    """The numbers of an element, which may have attributes."""
    text = value.get("text", "") if isinstance(value, Keys) else value
    return numbers(str(text).split(), where, count)


def _add_cameras(
    chunk: Keys, sensors: dict[str, Camera], offsets: dict[str, torch.Tensor], calibration: Calibration
) -> None:
    path = calibration.path
    elements = {str(camera.get("id")): camera for camera in _cameras_in(chunk.get("cameras"))}
    components = {str(part.get("id")): part for part in _each(chunk.get("components"), "component")}
    used = set()
    disabled: dict[str, Keys] = {}
    for camera in elements.values():
        sensor, name = f"cam{camera.get('sensor_id')}", view_name(camera.get("label") or camera.get("id"))
        where = f"{path}, camera {name!r:.80}"
        if str(camera.get("enabled", "true")).strip().lower() in ("false", "0"):
            disabled[name] = camera
            continue
        master = elements.get(str(camera.get("master_id", camera.get("id"))))
        if master is None:
            raise FileFormatError(f"{where}, master_id: there is no camera {camera['master_id']!r:.80}")
        transform = camera.get("transform", master.get("transform"))
        if transform is None:
            continue  # was not aligned
        if name in calibration.cameras:
            raise FileFormatError(
                f"{where}: a second camera has this label, perhaps in another group; give each a label of its own in "
                "Metashape, such as group/image"
            )
        if sensor not in sensors:
            raise FileFormatError(f"{where}: expected a sensor of {', '.join(sensors)}, got {sensor}")
        if _floats(camera.get("orientation", "1"), f"{where}, orientation", 1) != [1.0]:
            raise FileFormatError(f"{where}, orientation: expected 1, got a turned image; align it upright")
        pose = transform_from_rows(_floats(transform, f"{where}, transform"), f"{where}, transform")
        if "transform" not in camera:
            if sensor not in offsets:
                raise FileFormatError(
                    f"{where}: has a master, and its sensor {sensor} neither rotation nor location"
                )
            pose = pose @ offsets[sensor]
        used.add(str(master.get("component_id")))
        calibration.cameras[name] = sensors[sensor]
        calibration.poses.append(pose)
    if not calibration.cameras:
        raise FileFormatError(f"{path}: no camera in it is enabled and has a transform")
    warn_left_out(path, "which the file marks as disabled", list(disabled))
    for camera in disabled.values():  # which may be the master of another one
        camera.clear()
    if len(used) > 1:
        raise FileFormatError(
            f"{path}: the cameras are of {len(used)} components, which have no common frame; export one"
        )
    metres = _metres(chunk, components.get(used.pop()), path)
    for pose in calibration.poses:
        pose[:3, 3] *= metres


def _cameras_in(values: Any) -> Iterator[Keys]:
    """The cameras of a chunk and of its groups."""
    yield from _each(values, "camera")
    for group in _each(values, "group"):
        yield from _cameras_in(group)


def _metres(chunk: Any, component: Any, path: Path) -> float:
    """The scale that the component or the chunk says, or 1."""
    scales = [
        _floats(transform["scale"], f"{path}, scale", 1)[0]
        for place in (chunk, component)
        for transform in _each(place, "transform")
        if "scale" in transform
    ]
    if any(scale <= 0 or abs(scale / scales[0] - 1) > 1e-6 for scale in scales):
        raise FileFormatError(
            f"{path}, scale: expected one number above 0 of chunk and component, got {scales}"
        )
    return scales[-1] if scales else 1.0


def _camera(values: Keys, sensor: Keys, where: str) -> Camera:
    def get(key: str) -> float:
        return _floats(values[key], f"{where}, {key}", 1)[0] if key in values else 0.0

    entries = ((values, "type"), (values, "projection"), (sensor, "type"))
    kinds = {str(place[key]).strip() for place, key in entries if key in place}
    kind = chosen(kinds.pop() if kinds else "frame", _TYPES, f"{where}, type")
    if kinds:
        raise FileFormatError(f"{where}, type: {kind} and {' and '.join(kinds)} are told; keep the right one")
    resolutions = [place.inner("resolution") for place in (values, sensor) if "resolution" in place]
    sizes = {resolution.size("width", "height") for resolution in resolutions}
    if "width" in values or "height" in values or not sizes:
        sides = [get("width"), get("height")]
        sizes.add(size_from_width_height(sides, f"{where}, width and height"))
    size, *others = sizes
    if others:
        raise FileFormatError(f"{where}, resolution: {size} and {others[0]} are told; keep the right one")
    if kind == "spherical":
        if "f" in values and abs(get("f") * 2 * math.pi / size[1] - 1) > 0.01:
            raise FileFormatError(
                f"{where}, f: expected the width over 2π of a {kind} camera, got {get('f'):g}"
            )
        return EquirectangularCamera(size)
    f, cx, cy, k1, k2, k3, k4, p1, p2, p3, p4, b1, b2 = (get(key) for key in _KEYS)
    if (kind != "frame" and b2) or (kind == "frame" and k4) or p3 or p4:
        raise FileFormatError(
            f"{where}: b2 (skew) of a fisheye, k4 of a frame camera, p3 and p4 have no place in a camera here, got "
            f"b2 = {b2:g}, k4 = {k4:g}, p3 = {p3:g} and p4 = {p4:g}; calibrate without them"
        )
    plane = [f + b1, f, size[1] / 2 + cx - 0.5, size[0] / 2 + cy - 0.5]
    coefficients = [k1, k2, k3, p1, p2, k4]
    if kind == "equisolid_fisheye":
        if any(coefficients):
            raise FileFormatError(
                f"{where}: an {kind} with k1 k2 k3 p1 p2 k4 = {coefficients} has no camera here; calibrate without "
                "them, or as equidistant_fisheye"
            )
        return _EQUISOLID.camera(plane, size, where)
    if kind != "frame":
        return _FISHEYE.camera([*plane, *coefficients], size, where)
    lens = _FRAME if any(coefficients) else _PLAIN
    return lens.camera([*plane, *coefficients[:5]], size, where, skew=b2 or None)


FileFormat(
    "metashape",
    "Metashape xml",
    recognizes_keys=recognizes,
    read_keys=read,
    ignored=_IGNORED,
).register()
