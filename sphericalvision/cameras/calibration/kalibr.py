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

import re
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Calibration
from sphericalvision.cameras.calibration.formats import FileFormat
from sphericalvision.cameras.calibration.keys import Keys
from sphericalvision.cameras.calibration.lenses import Lens, as_rig, lens_called, lens_of, models_of
from sphericalvision.cameras.calibration.parsing import chosen_model, numbers
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import FileFormatError
from sphericalvision.geometry import invert_transform
from sphericalvision.io.yaml_files import write_yaml

_LENSES = (
    Lens("pinhole none", "pinhole", "fu=fx fv=fy pu=cx pv=cy"),
    Lens("pinhole radtan", "brown_conrady", "fu=fx fv=fy pu=cx pv=cy k1 k2 p1 p2"),
    Lens("pinhole equidistant", "kannala_brandt", "fu=fx fv=fy pu=cx pv=cy k1 k2 k3 k4"),
    Lens("pinhole fov", "atan", "fu=fx fv=fy pu=cx pv=cy w=omega"),
    Lens("omni radtan", "unified", "xi fu=fx fv=fy pu=cx pv=cy k1 k2 p1 p2", zeros="k3"),
    Lens("omni none", "unified", "xi fu=fx fv=fy pu=cx pv=cy"),
    Lens("eucm none", "extended_unified", "alpha beta fu=fx fv=fy pu=cx pv=cy"),
    Lens("ds none", "double_sphere", "xi alpha fu=fx fv=fy pu=cx pv=cy"),
)
"""The camera's and the distortion's model, and both lists of numbers."""
_COUNTS = {"none": 0, "fov": 1}
"""Of the distortion; 4 otherwise."""


def _names(content: dict[str, Any]) -> list[str]:
    names = [key for key in content if isinstance(key, str) and re.fullmatch(r"cam\d+", key)]
    return sorted(names, key=lambda name: int(name[3:]))


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file has ``cam0``, ``cam1``, ... with keys as Kalibr writes them."""
    keys = {"camera_model", "intrinsics", "distortion_coeffs", "T_cn_cnm1", "cam_overlaps"}
    return any(not isinstance(content[name], dict) or keys & set(content[name]) for name in _names(content))


def read(content: Keys, calibration: Calibration) -> None:
    """Cameras and poses of a parsed camchain."""
    names = _names(content)
    chain = [content.inner(name) for name in names]
    topics = [topic for values in chain if (topic := values.get("rostopic", ""))]
    if copied := [topic for topic in topics if topics.count(topic) > 1]:
        raise FileFormatError(
            f"{content.where}: two cameras have the rostopic {copied[0]!r:.80}; correct one"
        )
    cameras = [_camera(values) for values in chain]
    poses = _poses(chain, names, calibration.path)
    for name, values, camera, pose in zip(names, chain, cameras, poses, strict=True):
        calibration.add(name, camera, values.where, pose)


def _camera(values: Keys) -> Camera:
    kind = values.model("camera_model", dict.fromkeys(lens.name.split()[0] for lens in _LENSES))
    fitting = [name for lens in _LENSES for first, name in [lens.name.split()] if first == kind]
    distortion = chosen_model(
        values.get("distortion_model", "none"), fitting, f"{values.at('distortion_model')} of a {kind}"
    )
    lens = lens_called(_LENSES, f"{kind} {distortion}")
    last = _COUNTS.get(distortion, 4)
    order = lens.keys[: len(lens.keys) - last]
    intrinsics = numbers(
        values.entry("intrinsics"), f"{values.at('intrinsics')} ({' '.join(order)})", len(order)
    )
    intrinsics += values.coefficients("distortion_coeffs", last)
    return lens.camera(intrinsics, values.size("resolution"), values.where)


def _poses(chain: list[Keys], names: list[str], path: Path) -> list[Tensor | None]:
    """Camera to world (4, 4) of each: from the IMU's transforms if all cameras have one, else along the chain.

    None for one camera without a transform: nothing says where it is.
    """
    to_imu = [_imu_from_camera(values) for values in chain]
    steps = [values.pose("T_cn_cnm1") if "T_cn_cnm1" in values else None for values in chain]
    if steps[0] is not None:
        raise FileFormatError(
            f"{path}, {names[0]}, T_cn_cnm1: expected none of the first camera; is cam0 missing?"
        )
    for last, name, step, before, pose in zip(names, names[1:], steps[1:], to_imu, to_imu[1:], strict=False):
        follows = int(name[3:]) == int(last[3:]) + 1
        if follows and step is not None and before is not None and pose is not None:
            _compare(step, before, pose, f"{path}, {name}")
    if len(names) == 1 or all(pose is not None for pose in to_imu):
        return to_imu
    poses = [torch.eye(4, dtype=torch.float64)]
    for last, name, step in zip(names, names[1:], steps[1:], strict=False):
        if step is None or int(last[3:]) != int(name[3:]) - 1:
            problem = (
                "the key 'T_cn_cnm1' is missing"
                if step is None
                else f"cam{int(name[3:]) - 1}, the camera before, is missing"
            )
            raise FileFormatError(f"{path}, {name}: {problem}, and not all have T_cam_imu")
        poses.append(poses[-1] @ invert_transform(step))
    return [*poses]


def _compare(step: Tensor, before: Tensor, pose: Tensor, where: str) -> None:
    """Raise where the transform from the camera before and those of the IMU contradict each other."""
    if _near(step, invert_transform(pose) @ before):
        return
    fits = _near(step, pose @ invert_transform(before))
    raise FileFormatError(
        f"{where}: T_cn_cnm1 and the transforms from the IMU contradict each other; "
        + (
            "they agree when T_cam_imu is taken for its inverse, T_imu_cam: rename it if so"
            if fits
            else "keep the right ones"
        )
    )


def _near(first: Tensor, second: Tensor) -> bool:
    """To one degree and two centimetres."""
    return bool((first - second).abs().max() < 0.02)


def _imu_from_camera(values: Keys) -> Tensor | None:
    """Of ``T_cam_imu`` as Kalibr writes it, or ``T_imu_cam`` as OpenVINS does; None without either."""
    poses = []
    if "T_cam_imu" in values:
        poses.append(invert_transform(values.pose("T_cam_imu")))
    if "T_imu_cam" in values:
        poses.append(values.pose("T_imu_cam"))
    if len(poses) == 2 and not _near(*poses):
        raise FileFormatError(
            f"{values.where}: T_cam_imu and T_imu_cam contradict each other; keep the right one"
        )
    return poses[0] if poses else None


def write_kalibr(cameras: Camera | CameraRig, path: str | Path) -> None:
    """Write a camera or a rig as a camchain; cameras become ``cam0``, ``cam1``, ... in their order.

    ``T_cn_cnm1`` and ``T_cam_imu`` are both written, the rig's world in place of the IMU. Fields of view and masks are
    not part of the format.
    """
    rig = as_rig(cameras)
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
    lens, intrinsics = lens_of(camera, _LENSES, "kalibr")
    kind, distortion = lens.name.split()
    first = len(intrinsics) - _COUNTS.get(distortion, 4)
    return {
        "camera_model": kind,
        "intrinsics": intrinsics[:first],
        "distortion_model": distortion,
        "distortion_coeffs": intrinsics[first:],
        "resolution": list(camera.image_size[::-1]),
    }


FileFormat(
    "kalibr",
    "Kalibr camchain",
    recognizes_keys=recognizes,
    read_keys=read,
    ignored=r"imu\d*|T_imu_body|.*/(rostopic|cam_overlaps|line_delay\w*)",
    usual_names=("camchain.yaml",),
    models=models_of(_LENSES),
    write_camera=write_kalibr,
    write_rig=write_kalibr,
).register()
