# SPDX-License-Identifier: Apache-2.0
"""Basalt's calibration json: double sphere, (extended) unified, Kannala-Brandt and pinhole cameras; metres.

Convention:
    ``T_imu_cam`` is a quaternion (qx, qy, qz, qw) and a position, camera to IMU; the IMU's frame is the rig's world.
    Cameras are ``cam0``, ``cam1``, ... A file ``cam0/mask.png`` beside it, white where pixels are usable, is its mask.
    ``pinhole-radtan8`` is OpenCV's rational model; its ``rpmax``, unless 0, is the largest undistorted radius.
    Basalt's ``ucm`` has α = ξ / (1 + ξ) and focal lengths f = γ / (1 + ξ).
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import torch

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Contents, Options
from sphericalvision.cameras.calibration.formats import FileFormat, register_format
from sphericalvision.cameras.calibration.parsing import (
    entry,
    errors_of_file,
    focal_lengths,
    number,
    size_from_width_height,
)
from sphericalvision.cameras.calibration.poses import quaternion_from_rotation
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
from sphericalvision.geometry import transform_from_quaternion
from sphericalvision.io.files import atomic_write
from sphericalvision.io.images import read_mask, write_mask

__all__ = ["contents", "recognizes", "write_basalt"]

_PARAMETERS = {
    "ds": ("xi", "alpha"),
    "eucm": ("alpha", "beta"),
    "ucm": ("alpha",),
    "kb4": ("k1", "k2", "k3", "k4"),
    "pinhole": (),
    "pinhole-radtan8": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "rpmax"),
}
_POSITION, _QUATERNION = ("px", "py", "pz"), ("qw", "qx", "qy", "qz")


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file has ``value0``, as everything that Basalt writes."""
    return "value0" in content


def contents(content: Any, path: Path, options: Options) -> Contents:
    """Cameras, poses and masks of a parsed file.

    Raises:
        FileFormatError: a key is missing, or its value makes no sense; the message names file and key.
    """
    value0 = entry(content, "value0", str(path))
    parts = {key: entry(value0, key, f"{path}, value0") for key in ("T_imu_cam", "intrinsics", "resolution")}
    for key, values in parts.items():
        if not isinstance(values, list) or not values:
            raise FileFormatError(f"{path}, value0, {key}: expected a list of at least one entry")
    count = len(parts["intrinsics"])
    for key, values in parts.items():
        if len(values) != count:
            raise FileFormatError(
                f"{path}: {key} holds {len(values)} cameras and intrinsics {count}; one entry for each camera expected"
            )
    cameras, poses, masks = {}, [], {}
    for index in range(count):
        name, where = f"cam{index}", f"{path}, camera {index}"
        size = size_from_width_height(parts["resolution"][index], f"{where}, resolution")
        camera = _camera(parts["intrinsics"][index], size, where)
        mask_path = path.parent / name / "mask.png"
        if mask_path.is_file():
            masks[name] = read_mask(mask_path, size)
        cameras[name] = bounded(camera, options.max_angle, where, masks.get(name))
        poses.append(_pose(parts["T_imu_cam"][index], f"{where}, T_imu_cam"))
    table = torch.tensor(poses, dtype=torch.float64)
    return Contents(cameras, transform_from_quaternion(table[:, :4], table[:, 4:]), masks)


def _pose(values: Any, where: str) -> list[float]:
    """qw qx qy qz px py pz."""
    found = [number(values, key, where) for key in (*_QUATERNION, *_POSITION)]
    if not 0.99 < (length := math.hypot(*found[:4])) < 1.01:
        raise FileFormatError(f"{where}: expected a quaternion of length 1, got one of length {length:.3g}")
    return found


def _camera(values: Any, image_size: tuple[int, int], where: str) -> Camera:
    kind = entry(values, "camera_type", where)
    if not isinstance(kind, str) or kind not in _PARAMETERS:
        raise FileFormatError(
            f"{where}, camera_type: expected one of {', '.join(_PARAMETERS)}, got {short_repr(kind)}"
        )
    intrinsics = entry(values, "intrinsics", where)
    keys = ("fx", "fy", "cx", "cy", *_PARAMETERS[kind])
    fx, fy, cx, cy, *more = (number(intrinsics, key, where) for key in keys)
    center = [cx, cy]
    focal_length = torch.tensor(focal_lengths([fx, fy], f"{where}, fx and fy"), dtype=torch.float64)
    with errors_of_file(where):
        if kind == "ds":
            return DoubleSphereCamera(focal_length, center, more[0], more[1], image_size, math.pi)
        if kind == "eucm":
            return ExtendedUnifiedCamera(focal_length, center, more[0], more[1], image_size)
        if kind == "kb4":
            return KannalaBrandtCamera(focal_length, center, more, image_size, math.pi)
        if kind == "pinhole":
            return PinholeCamera(focal_length, center, image_size)
        if kind == "pinhole-radtan8":
            *distortion, radius = more
            max_angle = math.atan(radius) if radius > 0 else None
            return BrownConradyCamera(focal_length, center, distortion, image_size, max_angle)
        if not 0 <= more[0] < 1:
            raise FileFormatError(f"{where}, alpha: expected a number in [0, 1), got {more[0]:g}")
        xi = more[0] / (1 - more[0])
        return UnifiedCamera(focal_length * (1 + xi), center, xi, None, image_size)


def write_basalt(cameras: Camera | CameraRig, path: str | Path) -> None:
    """Write a camera or a rig as Basalt's json, and masks as ``cam0/mask.png``, ... beside it.

    Cameras become ``cam0``, ``cam1``, ... in their order. Only cameras are written: Basalt itself wants to find the
    IMU's calibration in the file, too. Fields of view are not part of the format.

    Raises:
        ArgumentError: Basalt has no such model; the message names formats that have it.
    """
    path = Path(path)
    rig = cameras if isinstance(cameras, CameraRig) else CameraRig([cameras], torch.eye(4)[None])
    value0: dict[str, list[Any]] = {"T_imu_cam": [], "intrinsics": [], "resolution": []}
    for camera, pose in zip(rig.cameras.values(), rig.world_from_camera, strict=True):
        kind, names, found = _values(camera)
        value0["intrinsics"].append({"camera_type": kind, "intrinsics": dict(zip(names, found, strict=True))})
        value0["resolution"].append(list(camera.image_size[::-1]))
        rotation = quaternion_from_rotation(pose[:3, :3])
        value0["T_imu_cam"].append(
            {
                **dict(zip(_POSITION, numbers_of(pose[:3, 3]), strict=True)),
                **dict(zip(_QUATERNION, rotation, strict=True)),
            }
        )
    for index, name in enumerate(rig.names):
        if name in rig.masks:
            folder = path.parent / f"cam{index}"
            folder.mkdir(exist_ok=True)
            write_mask(folder / "mask.png", rig.masks[name])
    with atomic_write(path) as unfinished:
        unfinished.write_text(json.dumps({"value0": value0}, indent=1) + "\n", encoding="utf-8")


def _values(camera: Camera) -> tuple[str, tuple[str, ...], list[float]]:
    """Basalt's name of the model, and names and values of its parameters."""
    check_holds("basalt", camera)
    assert isinstance(
        camera,
        PinholeCamera
        | BrownConradyCamera
        | KannalaBrandtCamera
        | DoubleSphereCamera
        | ExtendedUnifiedCamera
        | UnifiedCamera,
    )
    focal_length, more, kind = numbers_of(camera.focal_length), [], "pinhole"
    if isinstance(camera, UnifiedCamera):
        if camera.distortion is not None:
            without_trailing_zeros(numbers_of(camera.distortion), (0,), "distortion")
        xi = numbers_of(camera.xi)[0]
        kind, more = "ucm", [xi / (1 + xi)]
        focal_length = [value / (1 + xi) for value in focal_length]
    elif isinstance(camera, BrownConradyCamera):
        distortion = without_trailing_zeros(numbers_of(camera.distortion), (8,), "distortion")
        kind, more = "pinhole-radtan8", [*distortion, 0.0]
    elif isinstance(camera, KannalaBrandtCamera):
        kind = "kb4"
        more = without_trailing_zeros(numbers_of(camera.distortion), (4,), "distortion (k1 k2 k3 k4)")
    elif isinstance(camera, DoubleSphereCamera):
        kind, more = "ds", [*numbers_of(camera.xi), *numbers_of(camera.alpha)]
    elif isinstance(camera, ExtendedUnifiedCamera):
        kind, more = "eucm", [*numbers_of(camera.alpha), *numbers_of(camera.beta)]
    names = ("fx", "fy", "cx", "cy", *_PARAMETERS[kind])
    return kind, names, [*focal_length, *numbers_of(camera.principal_point), *more]


register_format(
    FileFormat(
        "basalt",
        "Basalt json",
        recognizes_keys=recognizes,
        contents_of_keys=contents,
        usual_names=("calibration.json",),
        models=("pinhole", "brown_conrady", "kannala_brandt", "double_sphere", "extended_unified", "unified"),
        write_camera=write_basalt,
        write_rig=write_basalt,
        holds_masks=True,
    )
)
