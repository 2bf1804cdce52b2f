# SPDX-License-Identifier: Apache-2.0
"""This package's own YAML: any camera, any rig.

A rig is a mapping with ``format: sphericalvision-rig`` and ``version: 1``, and a list ``cameras``. Each camera has
``name``, ``model``, ``image_size`` [height, width], ``max_angle`` in radians, the model's parameters under the names of
its constructor, ``world_from_camera`` (4 x 4, metres), and optionally ``mask``, an image beside the file that is white
where pixels are usable. A single camera is the same mapping without name and pose, and
``format: sphericalvision-camera``.
"""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import torch

from sphericalvision.cameras.base import Camera, check_single
from sphericalvision.cameras.calibration.contents import Contents, Options
from sphericalvision.cameras.calibration.formats import FileFormat, register_format
from sphericalvision.cameras.calibration.keys import Keys, as_keys, noted
from sphericalvision.cameras.calibration.parsing import (
    errors_of_file,
    numbers,
    size_from_width_height,
)
from sphericalvision.cameras.registry import camera_model, camera_model_names, check_registered
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import FileFormatError, short_repr
from sphericalvision.io.files import part_of_name, write_yaml
from sphericalvision.io.images import read_mask, write_mask

__all__ = [
    "CAMERA_FORMAT",
    "RIG_FORMAT",
    "camera_from_dict",
    "camera_to_dict",
    "contents",
    "recognizes",
    "write_camera",
    "write_rig",
]

CAMERA_FORMAT = "sphericalvision-camera"
RIG_FORMAT = "sphericalvision-rig"
VERSION = 1


def camera_to_dict(camera: Camera) -> dict[str, Any]:
    """Plain numbers and strings that ``camera_from_dict`` turns back into an equal camera.

    Raises:
        ArgumentError: the camera is a batch, or its class is not registered.

    Examples:
        >>> from sphericalvision.cameras import EquirectangularCamera
        >>> camera_to_dict(EquirectangularCamera((160, 320)))["image_size"]
        [160, 320]
    """
    check_single(camera)
    check_registered(camera)
    result: dict[str, Any] = {"model": camera.model, "image_size": list(camera.image_size)}
    options = {name: getattr(camera, name) for name in camera.option_names}
    result |= {name: list(value) if isinstance(value, tuple) else value for name, value in options.items()}
    tensors = {name: getattr(camera, name) for name in camera.intrinsic_names}
    tensors = {name: x for name, x in tensors.items() if x is not None or name not in camera.default_names}
    result |= {name: None if tensor is None else tensor.tolist() for name, tensor in tensors.items()}
    if _takes_max_angle(type(camera)):
        result["max_angle"] = camera.max_angle.item()
    return result


def camera_from_dict(values: Any, where: str, dtype: torch.dtype | None = None) -> Camera:
    """The camera of such a mapping; ``where`` names file and place in errors.

    Examples:
        >>> from sphericalvision.cameras import EquirectangularCamera
        >>> camera_from_dict(camera_to_dict(EquirectangularCamera((160, 320))), "here").image_size
        (160, 320)
    """
    values = as_keys(noted(values, where), where)
    name = values.entry("model")
    model = camera_model(name) if isinstance(name, str) else None
    if model is None:
        raise FileFormatError(
            f"{where}, model: expected one of {', '.join(camera_model_names())}, got {short_repr(name)}"
        )
    dtype = dtype or torch.get_default_dtype()
    sides = values.numbers("image_size", 2)
    arguments: dict[str, Any] = {"image_size": size_from_width_height(sides[::-1], values.at("image_size"))}
    options = (key for key in model.option_names if key in values or key not in model.default_names)
    arguments |= {key: values.entry(key) for key in options}
    for key in model.intrinsic_names:
        if key in model.default_names and key not in values:
            continue
        value = values.entry(key)
        if value is not None or key not in model.optional_names:
            parsed = values.numbers(key)
            value = torch.tensor(parsed if isinstance(value, list) else parsed[0], dtype=dtype)
        arguments[key] = value
    if _takes_max_angle(model):
        arguments["max_angle"] = values.number("max_angle")
    try:
        with errors_of_file(where):
            return model(**arguments)
    except TypeError as error:
        raise FileFormatError(f"{where}: {error}") from None


def write_camera(camera: Camera, path: str | Path) -> None:
    """Write one camera as YAML, which ``read_camera`` reads."""
    content = {"format": CAMERA_FORMAT, "version": VERSION, **camera_to_dict(camera)}
    write_yaml(path, content)


def write_rig(rig: CameraRig, path: str | Path) -> None:
    """Write a rig as YAML, which ``read_rig`` reads, and its masks as ``<stem>_<name>_mask.png`` beside it.

    Raises:
        ArgumentError: the rig is a batch, or a camera's class is not registered.
    """
    check_single(rig)
    path = Path(path)
    for camera in rig.cameras.values():  # before a mask is written
        check_registered(camera)
    cameras = []
    for (name, camera), pose in zip(rig.cameras.items(), rig.world_from_camera, strict=True):
        values = {"name": name, **camera_to_dict(camera), "world_from_camera": pose.tolist()}
        if name in rig.masks:
            values["mask"] = f"{path.stem}_{part_of_name(name)}_mask.png"
            write_mask(path.parent / values["mask"], rig.masks[name])
        cameras.append(values)
    write_yaml(path, {"format": RIG_FORMAT, "version": VERSION, "cameras": cameras})


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file says that it is of this package."""
    return content.get("format") in (CAMERA_FORMAT, RIG_FORMAT)


def contents(content: Keys, path: Path, options: Options) -> Contents:
    """The camera or the rig of a parsed file; masks are looked up beside ``path``.

    Raises:
        FileFormatError: a key is missing or its value makes no sense; the message names file and key.
        MissingFileError: a mask is named that does not exist.
    """
    version = content.entry("version")
    if version != VERSION:
        raise FileFormatError(
            f"{path}, version: this release reads version {VERSION}, got {short_repr(version)}"
        )
    if content["format"] == CAMERA_FORMAT:
        return Contents({path.stem: _limited(camera_from_dict(content, str(path), options.dtype), options)})
    cameras: dict[str, Camera] = {}
    poses, masks = [], {}
    for values in content.several("cameras"):
        name = str(values.entry("name"))
        if name in cameras:
            raise FileFormatError(f"{values.at('name')}: a second camera named {short_repr(name)}")
        cameras[name] = _limited(camera_from_dict(values, values.where, options.dtype), options)
        rows = values.entry("world_from_camera")
        flat = [value for row in rows for value in row] if _is_matrix(rows) else rows
        poses.append(numbers(flat, values.at("world_from_camera"), 16))
        if values.get("mask"):
            masks[name] = read_mask(path.parent / str(values["mask"]), cameras[name].image_size)
    return Contents(cameras, torch.tensor(poses, dtype=torch.float64).reshape(-1, 4, 4), masks)


def _takes_max_angle(model: type[Camera]) -> bool:
    """Whether the field of view is a choice: a panorama sees everything."""
    return "max_angle" in inspect.signature(model).parameters


def _limited(camera: Camera, options: Options) -> Camera:
    return camera if options.max_angle is None else camera.with_max_angle(options.max_angle)


def _is_matrix(rows: Any) -> bool:
    return isinstance(rows, list) and all(isinstance(row, list) for row in rows)


register_format(
    FileFormat(
        "native",
        "the package's own YAML (save_camera, save_rig)",
        recognizes_keys=recognizes,
        contents_of_keys=contents,
        ignored="config|dataset",  # of data sets, whose config.yaml may hold a rig of this kind
        usual_names=("rig.yaml",),
        write_camera=write_camera,
        write_rig=write_rig,
        holds_masks=True,
    )
)
