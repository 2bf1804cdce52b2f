# SPDX-License-Identifier: Apache-2.0
"""Write OpenCV's FileStorage, with the keys of its samples."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.files import STRUCTURED
from sphericalvision.cameras.calibration.supported_models import (
    check_holds,
    numbers_of,
    without_trailing_zeros,
)
from sphericalvision.cameras.models.brown_conrady import BrownConradyCamera
from sphericalvision.cameras.models.kannala_brandt import KannalaBrandtCamera
from sphericalvision.cameras.models.pinhole import PinholeCamera
from sphericalvision.cameras.models.unified import UnifiedCamera
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import ArgumentError
from sphericalvision.geometry import invert_transform
from sphericalvision.io.files import atomic_write

__all__ = ["write_opencv"]


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
    assert isinstance(camera, PinholeCamera | BrownConradyCamera | KannalaBrandtCamera | UnifiedCamera)
    (fx, fy), (cx, cy) = numbers_of(camera.focal_length), numbers_of(camera.principal_point)
    height, width = camera.image_size
    own_skew = getattr(camera, "skew", None)
    skew = 0.0 if own_skew is None else numbers_of(own_skew)[0]
    coefficients: list[float] = []
    if isinstance(camera, UnifiedCamera):
        coefficients = [0.0] * 4 if camera.distortion is None else numbers_of(camera.distortion)
        coefficients = without_trailing_zeros(coefficients, (4,), "distortion (k1 k2 p1 p2)")
    elif isinstance(camera, KannalaBrandtCamera):
        coefficients = without_trailing_zeros(numbers_of(camera.distortion), (4,), "distortion (k1 k2 k3 k4)")
    elif isinstance(camera, BrownConradyCamera):
        coefficients = numbers_of(camera.distortion)
    values: dict[str, Any] = {f"image_width{suffix}": width, f"image_height{suffix}": height}
    values[f"fisheye_model{suffix}"] = int(isinstance(camera, KannalaBrandtCamera))
    values[f"camera_matrix{suffix}"] = np.array([[fx, skew, cx], [0, fy, cy], [0, 0, 1]])
    values[f"distortion_coefficients{suffix}"] = np.array(coefficients).reshape(-1, 1)
    if isinstance(camera, UnifiedCamera):
        values[f"xi{suffix}"] = numbers_of(camera.xi)[0]
    return values
