# SPDX-License-Identifier: Apache-2.0
"""``config.yaml`` of the OmniMVS family: OCam cameras with poses in metres and fields of view in degrees."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch

from sphericalvision.cameras.calibration.numbers import check_radius, entry, numbers, read_mask
from sphericalvision.cameras.calibration.ocam_text import make_ocam
from sphericalvision.cameras.ocam import OCamCamera
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import FileFormatError
from sphericalvision.geometry import transform_from_axis_angle

__all__ = ["rig_from_omnimvs"]


def rig_from_omnimvs(
    content: Any, path: Path, *, max_angle: float | None = None, dtype: torch.dtype | None = None
) -> CameraRig:
    """The rig of a parsed ``config.yaml``; cameras are named ``cam<cam_id>``.

    Poses are axis-angle and translation in metres, camera to rig. ``invalid_mask`` images, white where a pixel must not
    be used, are read where they exist; they are seldom shipped.

    Args:
        content: the parsed file.
        path: where it came from, for masks and messages.
        max_angle: half the field of view in radians, instead of the file's ``max_fov``.
        dtype: of intrinsics and poses, by default torch's default.

    Raises:
        FileFormatError: a key is missing, or a value is none; the message names file and key.
    """
    cameras, poses, masks = {}, [], {}
    entries = entry(content, "cameras", str(path))
    if not isinstance(entries, list) or not entries:
        raise FileFormatError(f"{path}, cameras: expected a list of at least one camera")
    for index, values in enumerate(entries):
        where = f"{path}, cameras[{index}]"
        name = f"cam{entry(values, 'cam_id', where)}"
        where += f" ({name})"
        if name in cameras:
            raise FileFormatError(f"{where}: a second camera with this cam_id")
        cameras[name] = _camera(values, where, max_angle, dtype)
        poses.append(numbers(entry(values, "pose", where), f"{where}, pose", 6))
        mask = values.get("invalid_mask")
        if mask and (path.parent / str(mask)).is_file():
            masks[name] = ~read_mask(path.parent / str(mask), cameras[name].image_size)
    table = torch.tensor(poses, dtype=torch.float64)
    world_from_camera = transform_from_axis_angle(table[:, :3], table[:, 3:])
    return check_radius(
        CameraRig(cameras, world_from_camera.to(dtype or torch.get_default_dtype()), masks), path
    )


def _camera(values: Any, where: str, max_angle: float | None, dtype: torch.dtype | None) -> OCamCamera:
    model = values.get("model", "ocam")
    if model != "ocam":
        raise FileFormatError(f"{where}, model: expected ocam, got {model!r}")
    if max_angle is None and "max_fov" in values:
        max_angle = math.radians(numbers(values["max_fov"], f"{where}, max_fov", 1)[0]) / 2
    inverse = numbers(values["inv_poly"], f"{where}, inv_poly") if values.get("inv_poly") else None
    return make_ocam(
        numbers(entry(values, "poly", where), f"{where}, poly"),
        inverse,
        numbers(entry(values, "center", where), f"{where}, center", 2),
        numbers(entry(values, "affine", where), f"{where}, affine", 3),
        numbers(entry(values, "image_size", where), f"{where}, image_size", 2),
        max_angle,
        where,
        dtype,
    )
