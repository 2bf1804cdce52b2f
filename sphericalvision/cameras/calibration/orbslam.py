# SPDX-License-Identifier: Apache-2.0
"""ORB-SLAM3's settings: one camera or two, pinhole or Kannala-Brandt, in the present and in the older spelling.

Convention:
    ``Stereo.T_c1_c2`` (formerly ``Tlr``) takes coordinates of the second camera to the first, in metres, and
    ``IMU.T_b_c1`` (formerly ``Tbc``) those of the first to the body. With the latter the body is the rig's world, else
    the first camera. The cameras are called ``cam1`` and ``cam2``.

References:
    C. Campos et al., "ORB-SLAM3", T-RO 37 (2021), and ``Calibration_Tutorial.pdf`` of its repository.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Calibration
from sphericalvision.cameras.calibration.formats import FileFormat
from sphericalvision.cameras.calibration.keys import SETTINGS, Keys
from sphericalvision.cameras.calibration.lenses import Lens, lens_of, models_of, numbers_of
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import ArgumentError, FileFormatError, short_repr
from sphericalvision.geometry import invert_transform
from sphericalvision.io.files import write_bytes

_LENSES = (
    Lens("KannalaBrandt8", "kannala_brandt", "fx fy cx cy k1 k2 k3 k4"),
    Lens("Rectified", "pinhole", "fx fy cx cy"),
    Lens("PinHole", "brown_conrady", "fx fy cx cy k1 k2 p1 p2"),
    Lens("PinHole", "brown_conrady", "fx fy cx cy k1 k2 p1 p2 k3"),
)
"""An undistorted pinhole is written without k1, and then read as ``Rectified`` is."""
_STEREO, _BODY = ("Stereo.T_c1_c2", "Tlr"), ("IMU.T_b_c1", "Tbc")


def recognizes(content: dict[str, Any]) -> bool:
    """Whether keys are ORB-SLAM's: stella_vslam's has ``Camera.cols``."""
    is_ours = any(key in content for key in ("Camera1.fx", "Camera.fx", "Camera.type"))
    return is_ours and not any(key in content for key in ("Camera.model", "Camera.cols", "Camera.rows"))


def read(content: Keys, calibration: Calibration) -> None:
    """The camera or the two cameras of a parsed file, and their poses as far as the file has any."""
    first = "Camera1" if any(str(key).startswith("Camera1.") for key in content) else "Camera"
    body, stereo = _transform(content, _BODY), _transform(content, _STEREO)
    start = torch.eye(4, dtype=torch.float64) if body is None else body
    if "Camera2.fx" not in content:
        calibration.add("cam1", _camera(content, first), content.at(first), body)
        return
    calibration.add("cam1", _camera(content, first), content.at(first), start)
    second = None if stereo is None else start @ stereo
    length = 0.0 if stereo is None else float(stereo[:3, 3].norm())
    if length and abs(length - content.number("Stereo.b", length)) > 0.05 * length:
        raise FileFormatError(
            f"{content.at('Stereo.b')}: expected the {length:.3g} m of T_c1_c2, got another baseline; correct one"
        )
    calibration.add("cam2", _camera(content, "Camera2"), content.at("Camera2"), second)


def _transform(content: Keys, keys: tuple[str, ...]) -> Tensor | None:
    return next((content.pose(key) for key in keys if key in content), None)


def _camera(content: Keys, prefix: str) -> Camera:
    kind = content.entry("Camera.type")
    kinds = {lens.name.lower(): lens for lens in reversed(_LENSES)}
    if not isinstance(kind, str) or kind.lower() not in kinds:
        raise FileFormatError(
            f"{content.at('Camera.type')}: expected PinHole, KannalaBrandt8 or Rectified, got {short_repr(kind)}"
        )
    lens = kinds[kind.lower()]
    if lens.name == "PinHole" and f"{prefix}.k1" not in content:
        lens = kinds["rectified"]
    elif lens.name == "PinHole" and f"{prefix}.k3" in content:
        lens = _LENSES[-1]
    if lens.model != "kannala_brandt" and content.get("Camera.bFishEye", content.get("Camera.bfisheye")):
        raise FileFormatError(f"{content.where}: bFishEye is 1 and Camera.type {kind}; keep the right one")
    intrinsics = [content.number(f"{prefix}.{key}") for key in lens.keys]
    return lens.camera(intrinsics, content.size("Camera.width", "Camera.height"), content.at(prefix))


def write_orbslam(cameras: Camera | CameraRig, path: str | Path) -> None:
    """Write a camera, or a rig of two of one model; the rig's world takes the body's place.

    Only what belongs to the cameras is written; the settings of the program are the user's. Fields of view and masks
    are not part of the format.
    """
    several = list(cameras.cameras.values()) if isinstance(cameras, CameraRig) else [cameras]
    written = [lens_of(camera, _LENSES, "orbslam") for camera in several]
    if len(several) > 2 or len({(type(camera), camera.image_size) for camera in several}) > 1:
        raise ArgumentError(
            f"rig: ORB-SLAM3 holds one camera, or two of one model and image size, got {several}; choose two with "
            "rig.subset([...]), or write 'kalibr', 'basalt' or 'native'"
        )
    kind = "KannalaBrandt8" if written[0][0].name == "KannalaBrandt8" else "PinHole"
    height, width = several[0].image_size
    lines = ["%YAML:1.0", 'File.version: "1.0"', f'Camera.type: "{kind}"']
    lines += [f"Camera.width: {width}", f"Camera.height: {height}"]
    for index, (lens, intrinsics) in enumerate(written, start=1):
        lines += [f"Camera{index}.{key}: {value!r}" for key, value in zip(lens.keys, intrinsics, strict=True)]
    if isinstance(cameras, CameraRig):
        poses = cameras.world_from_camera.detach().cpu().double()
        lines += _matrix_lines(_BODY[0], poses[0])
        if len(several) == 2:
            lines += _matrix_lines(_STEREO[0], invert_transform(poses[0]) @ poses[1])
    write_bytes(path, ("\n".join(lines) + "\n").encode())


def _matrix_lines(key: str, transform: Tensor) -> list[str]:
    data = ", ".join(repr(value) for value in numbers_of(transform))
    return [f"{key}: !!opencv-matrix", "   rows: 4", "   cols: 4", "   dt: d", f"   data: [ {data} ]"]


FileFormat(
    "orbslam",
    "ORB-SLAM3 settings",
    recognizes_keys=recognizes,
    read_keys=read,
    ignored=SETTINGS + r"(?!Camera|Stereo|IMU\.T|LEFT|RIGHT|T).*|ThDepth"
    r"|Camera\d?\.(fps|RGB|bf|b[Ff]ish[Ee]ye|newWidth|newHeight|imageScale|(overl|l)apping(Begin|End))|Stereo\.(ThDepth|b)",
    models=models_of(_LENSES),
    write_camera=write_orbslam,
    write_rig=write_orbslam,
).register()
