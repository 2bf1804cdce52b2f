# SPDX-License-Identifier: Apache-2.0
"""Write OpenCV's FileStorage, with the keys of its samples."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.files import STRUCTURED
from sphericalvision.cameras.calibration.lenses import check_holds, numbers_of
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import ArgumentError
from sphericalvision.geometry import invert_transform
from sphericalvision.io.files import atomic_write

__all__ = ["write_opencv"]

_FOUR = ("kannala_brandt", "unified")
"""Models of ``cv2.fisheye`` and ``cv2.omnidir``, which have so many coefficients."""


def write_opencv(cameras: Camera | CameraRig, path: str | Path) -> None:
    """Write a camera, or a rig of two, as a FileStorage; the suffix (.yaml, .yml, .xml or .json) says of which kind.

    Fields of view and masks are not part of the format, and the frame of the first camera becomes the world.

    Raises:
        ArgumentError: OpenCV has no such model, the rig has more than two cameras, or the suffix is another one.
    """
    path = Path(path)
    if path.suffix.lower() not in STRUCTURED:
        raise ArgumentError(
            f"path: expected the suffix .yaml, .yml, .xml or .json for OpenCV, got {path.name}"
        )
    values: dict[str, Any]
    if isinstance(cameras, CameraRig):
        if len(cameras) != 2:
            raise ArgumentError(
                f"rig: OpenCV's files hold one camera or two, this rig has {len(cameras)}; choose two with "
                "rig.subset([...]), or write 'kalibr', 'basalt' or 'native'"
            )
        first, second = cameras.cameras.values()
        poses = cameras.world_from_camera.detach().cpu().double()
        second_from_first = invert_transform(poses[1]) @ poses[0]
        values = {
            **_values(first, "_1"),
            **_values(second, "_2"),
            "R": second_from_first[:3, :3].numpy(),
            "T": second_from_first[:3, 3:].numpy(),
            "translation_unit": "m",
        }
    else:
        values = _values(cameras, "")
    with atomic_write(path) as unfinished:
        storage = cv2.FileStorage(str(unfinished), cv2.FILE_STORAGE_WRITE)
        for key, value in values.items():
            storage.write(key, value)
        storage.release()


def _values(camera: Camera, suffix: str) -> dict[str, Any]:
    check_holds("opencv", camera)
    tensors = {name: getattr(camera, name) for name in camera.intrinsic_names}
    numbers = {name: numbers_of(tensor) for name, tensor in tensors.items() if tensor is not None}
    (fx, fy), (cx, cy), (skew,) = (
        numbers.get(name, [0.0]) for name in ("focal_length", "principal_point", "skew")
    )
    coefficients = numbers.get("distortion", [0.0] * 4 if "xi" in numbers else [])
    if camera.model in _FOUR:
        if any(coefficients[4:]):
            raise ArgumentError(
                f"camera: OpenCV holds 4 numbers of distortion of {camera.model}, got {coefficients}; write it "
                "as 'native', or convert the camera first: camera.convert(to=...)"
            )
        coefficients = (coefficients + [0.0] * 4)[:4]
    height, width = camera.image_size
    values: dict[str, Any] = {f"image_width{suffix}": width, f"image_height{suffix}": height}
    values[f"fisheye_model{suffix}"] = int(camera.model == "kannala_brandt")
    values[f"camera_matrix{suffix}"] = np.array([[fx, skew, cx], [0, fy, cy], [0, 0, 1]])
    values[f"distortion_coefficients{suffix}"] = np.array(coefficients).reshape(-1, 1)
    if "xi" in numbers:
        values[f"xi{suffix}"] = numbers["xi"][0]
    return values
