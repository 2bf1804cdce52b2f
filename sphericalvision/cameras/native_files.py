# SPDX-License-Identifier: Apache-2.0
"""Writing this package's own YAML: any camera, any rig.

A rig is a mapping with ``format: sphericalvision-rig`` and ``version: 1``, and a list ``cameras``. Each camera has
``name``, ``model``, ``image_size`` [height, width], ``max_angle`` in radians, the model's parameters under the names of
its constructor, ``world_from_camera`` (4 x 4, metres), and optionally ``mask``, an image beside the file that is white
where pixels are usable. A single camera is the same mapping without name and pose, and
``format: sphericalvision-camera``.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.cameras.base import Camera, check_single
from sphericalvision.cameras.registry import check_registered
from sphericalvision.io.files import part_of_name, refuse_folder
from sphericalvision.io.images import write_mask
from sphericalvision.io.yaml_files import write_yaml

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
    if takes_max_angle(type(camera)):
        result["max_angle"] = camera.max_angle.item()
    return result


def write_camera(camera: Camera, path: str | Path) -> None:
    """Write one camera as YAML, which ``read_camera`` reads."""
    content = {"format": CAMERA_FORMAT, "version": VERSION, **camera_to_dict(camera)}
    write_yaml(path, content)


def write_rig(
    path: str | Path,
    cameras: Mapping[str, Camera],
    world_from_camera: Float[Tensor, "n 4 4"],
    masks: Mapping[str, Bool[Tensor, " ..."]],
) -> None:
    """Write a rig as YAML, which ``read_rig`` reads, and its masks as ``<stem>_<name>_mask.png`` beside it."""
    path = Path(path)
    files = {name: {"mask": f"{path.stem}_{part_of_name(name)}_mask.png"} for name in masks}
    entries = [
        {"name": name, **camera_to_dict(camera), "world_from_camera": pose.tolist(), **files.get(name, {})}
        for (name, camera), pose in zip(cameras.items(), world_from_camera, strict=True)
    ]
    refuse_folder(path)
    for name, mask in masks.items():
        write_mask(path.parent / files[name]["mask"], mask)
    write_yaml(path, {"format": RIG_FORMAT, "version": VERSION, "cameras": entries})


def takes_max_angle(model: type[Camera]) -> bool:
    """Whether the field of view is a choice: a panorama sees everything."""
    return "max_angle" in inspect.signature(model).parameters
