# SPDX-License-Identifier: Apache-2.0
"""Reading this package's own YAML, which ``native_files`` describes and writes."""

from __future__ import annotations

from typing import Any

import torch

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Calibration, Options
from sphericalvision.cameras.calibration.formats import FileFormat
from sphericalvision.cameras.calibration.keys import Keys, as_keys, with_keys
from sphericalvision.cameras.calibration.parsing import errors_of_file, size_from_width_height
from sphericalvision.cameras.native_files import (
    CAMERA_FORMAT,
    RIG_FORMAT,
    VERSION,
    takes_max_angle,
    write_camera,
)
from sphericalvision.cameras.registry import camera_model, camera_model_names
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import FileFormatError, short_repr
from sphericalvision.io.images import read_mask


def camera_from_dict(values: Any, where: str, dtype: torch.dtype | None = None) -> Camera:
    """The camera of such a mapping; ``where`` names file and place in errors.

    Examples:
        >>> from sphericalvision.cameras import EquirectangularCamera
        >>> from sphericalvision.cameras.native_files import camera_to_dict
        >>> camera_from_dict(camera_to_dict(EquirectangularCamera((160, 320))), "here").image_size
        (160, 320)
    """
    values = as_keys(with_keys(values, where), where)
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
    if takes_max_angle(model):
        arguments["max_angle"] = values.number("max_angle")
    try:
        with errors_of_file(where):
            return model(**arguments)
    except TypeError as error:
        raise FileFormatError(f"{where}: {error}") from None


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file says that it is of this package."""
    return content.get("format") in (CAMERA_FORMAT, RIG_FORMAT)


def read(content: Keys, calibration: Calibration) -> None:
    """The camera or the rig of a parsed file; masks are looked up beside ``path``."""
    path, options = calibration.path, calibration.options
    version = content.entry("version")
    if version != VERSION:
        raise FileFormatError(
            f"{content.where}, version: this release reads version {VERSION}, got {short_repr(version)}"
        )
    if content["format"] == CAMERA_FORMAT:
        camera = camera_from_dict(content, content.where, options.dtype)
        calibration.cameras[path.stem] = _limited(camera, options)
        return
    for values in content.several("cameras"):
        name = str(values.entry("name"))
        if name in calibration.cameras:
            raise FileFormatError(f"{values.at('name')}: a second camera named {short_repr(name)}")
        camera = _limited(camera_from_dict(values, values.where, options.dtype), options)
        calibration.cameras[name] = camera
        pose = values.matrix("world_from_camera", 16)
        calibration.poses.append(torch.tensor(pose, dtype=torch.float64).reshape(4, 4))
        if values.get("mask"):
            calibration.masks[name] = read_mask(path.parent / str(values["mask"]), camera.image_size)


def _limited(camera: Camera, options: Options) -> Camera:
    return camera if options.max_angle is None else camera.with_max_angle(options.max_angle)


FileFormat(
    "native",
    "the package's own YAML (save_camera, save_rig)",
    recognizes_keys=recognizes,
    read_keys=read,
    ignored="config|dataset",  # of data sets, whose config.yaml may hold a rig of this kind
    usual_names=("rig.yaml",),
    write_camera=write_camera,
    write_rig=CameraRig.to_yaml,
    models_with_skew=("pinhole", "brown_conrady", "kannala_brandt", "unified"),
    holds_masks=True,
).register()
