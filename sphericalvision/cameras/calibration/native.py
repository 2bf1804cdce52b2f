# SPDX-License-Identifier: Apache-2.0
"""This package's own YAML: any camera, any rig.

A rig is a mapping with ``format: sphericalvision-rig`` and ``version: 1``, and a list ``cameras``. Each camera has
``name``, ``model``, ``image_size`` [height, width], ``max_angle`` in radians, the model's parameters under the names of
its constructor, ``world_from_camera`` (4 x 4, metres), and optionally ``mask``, an image beside the file that is white
where pixels are usable. A single camera is the same mapping without name and pose, and
``format: sphericalvision-camera``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import torch
import yaml

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.numbers import check_radius, entry, mapping, numbers, read_mask
from sphericalvision.cameras.double_sphere import DoubleSphereCamera
from sphericalvision.cameras.equirectangular import EquirectangularCamera
from sphericalvision.cameras.fisheye import FisheyeCamera
from sphericalvision.cameras.kannala_brandt import KannalaBrandtCamera
from sphericalvision.cameras.ocam import OCamCamera
from sphericalvision.cameras.pinhole import PinholeCamera
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import ArgumentError, FileFormatError, SphericalVisionError

__all__ = [
    "CAMERA_FORMAT",
    "RIG_FORMAT",
    "camera_from_dict",
    "camera_to_dict",
    "rig_from_dict",
    "write_camera",
    "write_rig",
]

CAMERA_FORMAT = "sphericalvision-camera"
RIG_FORMAT = "sphericalvision-rig"
VERSION = 1

_MODELS: dict[str, type[Camera]] = {
    model.model: model
    for model in (
        DoubleSphereCamera,
        EquirectangularCamera,
        FisheyeCamera,
        KannalaBrandtCamera,
        OCamCamera,
        PinholeCamera,
    )
}

_OPTIONAL = ("inverse_polynomial",)
"""Parameters that a file may give as ``null``."""


def camera_to_dict(camera: Camera) -> dict[str, Any]:
    """Plain numbers and strings that ``camera_from_dict`` turns back into an equal camera.

    Examples:
        >>> camera_to_dict(EquirectangularCamera((160, 320)))["image_size"]
        [160, 320]
    """
    if camera.batch_shape:
        raise ArgumentError(
            f"camera: expected a single camera, got a batch {camera.batch_shape}; use select(index)"
        )
    result: dict[str, Any] = {"model": camera.model, "image_size": list(camera.image_size)}
    result |= {name: getattr(camera, name) for name in camera.option_names}
    tensors = {name: getattr(camera, name) for name in camera.intrinsic_names}
    result |= {name: None if tensor is None else tensor.tolist() for name, tensor in tensors.items()}
    if not isinstance(camera, EquirectangularCamera):
        result["max_angle"] = camera.max_angle.item()
    return result


def camera_from_dict(values: Any, where: str, dtype: torch.dtype | None = None) -> Camera:
    """The camera of such a mapping; ``where`` names file and place in errors.

    Examples:
        >>> camera_from_dict(camera_to_dict(EquirectangularCamera((160, 320))), "here").image_size
        (160, 320)
    """
    name = entry(values, "model", where)
    if not isinstance(name, str) or name not in _MODELS:
        raise FileFormatError(f"{where}, model: expected one of {', '.join(_MODELS)}, got {name!r}")
    model = _MODELS[name]
    dtype = dtype or torch.get_default_dtype()
    arguments: dict[str, Any] = {
        "image_size": numbers(entry(values, "image_size", where), f"{where}, image_size", 2)
    }
    arguments |= {key: entry(values, key, where) for key in model.option_names}
    for key in model.intrinsic_names:
        value = entry(values, key, where)
        if value is not None or key not in _OPTIONAL:
            parsed = numbers(value, f"{where}, {key}")
            value = torch.tensor(parsed if isinstance(value, list) else parsed[0], dtype=dtype)
        arguments[key] = value
    if model is not EquirectangularCamera:
        arguments["max_angle"] = numbers(entry(values, "max_angle", where), f"{where}, max_angle", 1)[0]
    try:
        return model(**arguments)
    except (SphericalVisionError, TypeError) as error:
        raise FileFormatError(f"{where}: {error}") from None


def write_camera(camera: Camera, path: str | Path) -> None:
    """Write one camera as YAML, which ``read_camera`` reads."""
    content = {"format": CAMERA_FORMAT, "version": VERSION, **camera_to_dict(camera)}
    _write(Path(path), content)


def write_rig(rig: CameraRig, path: str | Path) -> None:
    """Write a rig as YAML, which ``read_rig`` reads, and its masks as ``<stem>_<name>_mask.png`` beside it.

    Raises:
        ArgumentError: the rig is a batch.
    """
    if rig.world_from_camera.ndim != 3:
        raise ArgumentError("rig: expected a single rig, got a batch; use rig.select(index)")
    path = Path(path)
    cameras = []
    for (name, camera), pose in zip(rig.cameras.items(), rig.world_from_camera, strict=True):
        values = {"name": name, **camera_to_dict(camera), "world_from_camera": pose.tolist()}
        if name in rig.masks:
            values["mask"] = f"{path.stem}_{name}_mask.png"
            pixels = rig.masks[name].to("cpu", torch.uint8).numpy() * 255
            if not cv2.imwrite(str(path.parent / values["mask"]), pixels):
                raise OSError(f"{path.parent / values['mask']}: cannot be written")
        cameras.append(values)
    _write(path, {"format": RIG_FORMAT, "version": VERSION, "cameras": cameras})


def rig_from_dict(content: Any, path: Path, dtype: torch.dtype | None = None) -> CameraRig:
    """The rig of a parsed file; masks are looked up beside ``path``.

    Raises:
        FileFormatError: a key is missing or its value makes no sense; the message names file and key.
        MissingFileError: a mask is named that does not exist.
    """
    version = entry(content, "version", str(path))
    if version != VERSION:
        raise FileFormatError(f"{path}, version: this release reads version {VERSION}, got {version!r}")
    cameras: dict[str, Camera] = {}
    poses, masks = [], {}
    entries = entry(content, "cameras", str(path))
    if not isinstance(entries, list):
        raise FileFormatError(f"{path}, cameras: expected a list of cameras, got {type(entries).__name__}")
    for index, values in enumerate(entries):
        where = f"{path}, cameras[{index}]"
        name = str(entry(values, "name", where))
        if name in cameras:
            raise FileFormatError(f"{where}, name: a second camera named {name!r}")
        cameras[name] = camera_from_dict(mapping(values, where), where, dtype)
        rows = entry(values, "world_from_camera", where)
        flat = [value for row in rows for value in row] if _is_matrix(rows) else rows
        poses.append(numbers(flat, f"{where}, world_from_camera", 16))
        if values.get("mask"):
            masks[name] = read_mask(path.parent / str(values["mask"]), cameras[name].image_size)
    table = torch.tensor(poses, dtype=dtype or torch.get_default_dtype()).reshape(-1, 4, 4)
    try:
        return check_radius(CameraRig(cameras, table, masks), path)
    except ArgumentError as error:
        raise FileFormatError(f"{path}: {error}") from None


def _is_matrix(rows: Any) -> bool:
    return isinstance(rows, list) and all(isinstance(row, list) for row in rows)


def _write(path: Path, content: dict[str, Any]) -> None:
    """Write under another name first, so that a half-written calibration never has the final one."""
    unfinished = path.with_name(f".{path.name}.unfinished")
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=110)
    unfinished.write_text(text, encoding="utf-8")
    unfinished.replace(path)
