# SPDX-License-Identifier: Apache-2.0
"""Kalibr's camchain: ``cam0``, ``cam1``, ..., each with the transform from the camera before it.

Convention:
    ``T_cn_cnm1`` takes coordinates of the camera before to this camera's, and ``T_cam_imu`` the IMU's; both in metres.
    OpenVINS writes the inverse of the latter, ``T_imu_cam``.
    With ``T_cam_imu`` for every camera the world is the IMU's frame; else it is that of ``cam0``.

References:
    https://github.com/ethz-asl/kalibr/wiki/yaml-formats
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Contents, Options
from sphericalvision.cameras.calibration.formats import FileFormat, register_format
from sphericalvision.cameras.calibration.parsing import (
    entry,
    errors_of_file,
    focal_lengths,
    numbers,
    size_from_width_height,
)
from sphericalvision.cameras.calibration.poses import transform_from_rows
from sphericalvision.cameras.calibration.supported_models import (
    check_holds,
    numbers_of,
    without_trailing_zeros,
)
from sphericalvision.cameras.calibration.visible_part import bounded
from sphericalvision.cameras.models.brown_conrady import BrownConradyCamera
from sphericalvision.cameras.models.double_sphere import DoubleSphereCamera
from sphericalvision.cameras.models.extended_unified import ExtendedUnifiedCamera
from sphericalvision.cameras.models.kannala_brandt import KannalaBrandtCamera
from sphericalvision.cameras.models.pinhole import PinholeCamera
from sphericalvision.cameras.models.unified import UnifiedCamera
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import FileFormatError, short_repr
from sphericalvision.geometry import invert_transform
from sphericalvision.io.files import write_yaml

__all__ = ["contents", "recognizes", "write_kalibr"]

_INTRINSICS = {  # in Kalibr's order; the last four are always the focal lengths and the principal point
    "pinhole": ("fu", "fv", "pu", "pv"),
    "omni": ("xi", "fu", "fv", "pu", "pv"),
    "eucm": ("alpha", "beta", "fu", "fv", "pu", "pv"),
    "ds": ("xi", "alpha", "fu", "fv", "pu", "pv"),
}
_DISTORTIONS = {
    "pinhole": ("none", "radtan", "equidistant"),
    "omni": ("none", "radtan"),
    "eucm": ("none",),
    "ds": ("none",),
}

_Known = (
    PinholeCamera
    | BrownConradyCamera
    | KannalaBrandtCamera
    | DoubleSphereCamera
    | ExtendedUnifiedCamera
    | UnifiedCamera
)


def _names(content: dict[str, Any]) -> list[str]:
    found = [key for key in content if isinstance(key, str) and re.fullmatch(r"cam\d+", key)]
    return sorted(found, key=lambda name: int(name[3:]))


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file has ``cam0``, ``cam1``, ... as Kalibr writes them."""
    return bool(_names(content))


def contents(content: dict[str, Any], path: Path, options: Options) -> Contents:
    """Cameras and poses of a parsed camchain.

    Raises:
        FileFormatError: a key is missing, or its value makes no sense; the message names file and key.
    """
    names = _names(content)
    cameras = {}
    for name in names:
        where = f"{path}, {name}"
        cameras[name] = bounded(_camera(content[name], where), options.max_angle, where)
    return Contents(cameras, _poses(content, names, path))


def _camera(values: Any, where: str) -> Camera:
    kind = entry(values, "camera_model", where)
    if not isinstance(kind, str) or kind not in _INTRINSICS:
        raise FileFormatError(
            f"{where}, camera_model: expected one of {', '.join(_INTRINSICS)}, got {short_repr(kind)}"
        )
    distortion = values.get("distortion_model", "none")
    if distortion not in _DISTORTIONS[kind]:
        raise FileFormatError(
            f"{where}, distortion_model: expected {' or '.join(_DISTORTIONS[kind])} with {kind}, got "
            f"{short_repr(distortion)}"
        )
    order = _INTRINSICS[kind]
    found = numbers(
        entry(values, "intrinsics", where), f"{where}, intrinsics ({' '.join(order)})", len(order)
    )
    focal_length = torch.tensor(focal_lengths(found[-4:-2], f"{where}, intrinsics"), dtype=torch.float64)
    center = found[-2:]
    size = size_from_width_height(entry(values, "resolution", where), f"{where}, resolution")
    with errors_of_file(where):
        if kind == "ds":
            return DoubleSphereCamera(focal_length, center, found[0], found[1], size, math.pi)
        if kind == "eucm":
            return ExtendedUnifiedCamera(focal_length, center, found[0], found[1], size)
        if distortion == "none":
            if kind == "omni":
                return UnifiedCamera(focal_length, center, found[0], None, size)
            return PinholeCamera(focal_length, center, size)
        key = "distortion_coeffs"
        coefficients = numbers(entry(values, key, where), f"{where}, {key}", 4)
        if kind == "omni":
            return UnifiedCamera(focal_length, center, found[0], [*coefficients, 0.0], size)
        if distortion == "radtan":
            return BrownConradyCamera(focal_length, center, coefficients, size)
        return KannalaBrandtCamera(focal_length, center, coefficients, size, math.pi)


def _poses(content: dict[str, Any], names: list[str], path: Path) -> Tensor | None:
    """Camera to world (n, 4, 4): from the IMU's transforms if all cameras have one, else along the chain.

    None for one camera without a transform: nothing says where it is.
    """
    to_imu = [_imu_from_camera(content[name], f"{path}, {name}") for name in names]
    known = [pose for pose in to_imu if pose is not None]
    if len(known) == len(names):
        return torch.stack(known)
    if len(names) == 1:
        return None
    poses = [torch.eye(4, dtype=torch.float64)]
    for name in names[1:]:
        step = entry(content[name], "T_cn_cnm1", f"{path}, {name}")
        from_previous = transform_from_rows(step, f"{path}, {name}, T_cn_cnm1")
        poses.append(poses[-1] @ invert_transform(from_previous))
    return torch.stack(poses)


def _imu_from_camera(values: Any, where: str) -> Tensor | None:
    """Of ``T_cam_imu`` as Kalibr writes it, or ``T_imu_cam`` as OpenVINS does; None without either."""
    if "T_cam_imu" in values:
        return invert_transform(transform_from_rows(values["T_cam_imu"], f"{where}, T_cam_imu"))
    if "T_imu_cam" in values:
        return transform_from_rows(values["T_imu_cam"], f"{where}, T_imu_cam")
    return None


def write_kalibr(cameras: Camera | CameraRig, path: str | Path) -> None:
    """Write a camera or a rig as a camchain; cameras become ``cam0``, ``cam1``, ... in their order.

    ``T_cn_cnm1`` and ``T_cam_imu`` are both written, the rig's world in place of the IMU. Fields of view and masks are
    not part of the format.

    Raises:
        ArgumentError: Kalibr has no such model; the message names formats that have it.
    """
    rig = cameras if isinstance(cameras, CameraRig) else CameraRig([cameras], torch.eye(4)[None])
    content: dict[str, Any] = {}
    from_world = rig.camera_from_world.detach().cpu().double()
    world_from = rig.world_from_camera.detach().cpu().double()
    for index, camera in enumerate(rig.cameras.values()):
        content[f"cam{index}"] = values = _values(camera)
        values["T_cam_imu"] = from_world[index].tolist()
        if index:
            values["T_cn_cnm1"] = (from_world[index] @ world_from[index - 1]).tolist()
    write_yaml(path, content)


def _values(camera: Camera) -> dict[str, Any]:
    check_holds("kalibr", camera)
    assert isinstance(camera, _Known)
    kind, distortion = "pinhole", "none"
    before: list[float] = []
    coefficients: list[float] = []
    if isinstance(camera, BrownConradyCamera):
        distortion = "radtan"
        coefficients = without_trailing_zeros(numbers_of(camera.distortion), (4,), "distortion (k1 k2 p1 p2)")
    elif isinstance(camera, KannalaBrandtCamera):
        distortion = "equidistant"
        coefficients = without_trailing_zeros(numbers_of(camera.distortion), (4,), "distortion (k1 k2 k3 k4)")
    elif isinstance(camera, UnifiedCamera):
        kind, before = "omni", numbers_of(camera.xi)
        if camera.distortion is not None:
            distortion = "radtan"
            coefficients = without_trailing_zeros(
                numbers_of(camera.distortion), (4,), "distortion (k1 k2 p1 p2)"
            )
    elif isinstance(camera, ExtendedUnifiedCamera):
        kind, before = "eucm", [*numbers_of(camera.alpha), *numbers_of(camera.beta)]
    elif isinstance(camera, DoubleSphereCamera):
        kind, before = "ds", [*numbers_of(camera.xi), *numbers_of(camera.alpha)]
    height, width = camera.image_size
    return {
        "camera_model": kind,
        "intrinsics": [*before, *numbers_of(camera.focal_length), *numbers_of(camera.principal_point)],
        "distortion_model": distortion,
        "distortion_coeffs": coefficients,
        "resolution": [width, height],
    }


register_format(
    FileFormat(
        "kalibr",
        "Kalibr camchain",
        recognizes_keys=recognizes,
        contents_of_keys=contents,
        usual_names=("camchain.yaml",),
        models=("pinhole", "brown_conrady", "kannala_brandt", "double_sphere", "extended_unified", "unified"),
        write_camera=write_kalibr,
        write_rig=write_kalibr,
    )
)
