# SPDX-License-Identifier: Apache-2.0
"""Camodocal's YAML, which KITTI-360 and VINS use: Mei, pinhole and Kannala-Brandt cameras.

Convention:
    One file is one camera. KITTI-360's fisheyes are ``image_02.yaml`` and ``image_03.yaml``; their poses stand in
    ``calib_cam_to_pose.txt`` beside them, camera to the vehicle's GPS/IMU frame (x forward, y right, z down), in
    metres.

References:
    Y. Liao, J. Xie, A. Geiger, "KITTI-360", PAMI 45 (2023); C. Mei, P. Rives, "Single view point omnidirectional
    camera calibration from planar grids", ICRA 2007.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Contents, Options
from sphericalvision.cameras.calibration.files import data_lines, load
from sphericalvision.cameras.calibration.formats import FileFormat, register_format
from sphericalvision.cameras.calibration.parsing import (
    entry,
    errors_of_file,
    focal_lengths,
    number,
    size_from_width_height,
)
from sphericalvision.cameras.calibration.poses import transform_from_rows
from sphericalvision.cameras.calibration.visible_part import bounded
from sphericalvision.cameras.models.brown_conrady import BrownConradyCamera
from sphericalvision.cameras.models.kannala_brandt import KannalaBrandtCamera
from sphericalvision.cameras.models.unified import UnifiedCamera
from sphericalvision.core import FileFormatError, MissingFileError, short_repr
from sphericalvision.io.files import part_of_name

__all__ = ["KITTI360_POSES", "contents", "kitti360_contents", "recognizes"]

KITTI360_POSES = "calib_cam_to_pose.txt"
_MODELS = ("MEI", "PINHOLE", "KANNALA_BRANDT")
_SECTIONS = ("mirror_parameters", "projection_parameters", "distortion_parameters")


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file is a camera of camodocal, or several by name."""
    if "model_type" in content or any(key in content for key in _SECTIONS):
        return True
    cameras = [value for value in content.values() if isinstance(value, dict)]
    return bool(cameras) and all(recognizes(value) for value in cameras)


def contents(content: dict[str, Any], path: Path, options: Options) -> Contents:
    """The camera of a parsed file, called by its ``camera_name``; or several cameras by name.

    Raises:
        FileFormatError: a key is missing, or its value makes no sense; the message names file and key.
    """
    if "model_type" in content or any(key in content for key in _SECTIONS):
        camera = bounded(_camera(content, str(path)), options.max_angle, str(path))
        return Contents({str(content.get("camera_name") or path.stem): camera})
    named = {str(name): value for name, value in content.items() if isinstance(value, dict)}
    return Contents(
        {
            name: bounded(_camera(value, f"{path}, {name}"), options.max_angle, f"{path}, {name}")
            for name, value in named.items()
        }
    )


def _camera(values: dict[str, Any], where: str) -> Camera:
    kind = entry(values, "model_type", where)
    if not isinstance(kind, str) or kind.upper() not in _MODELS:
        raise FileFormatError(
            f"{where}, model_type: expected one of {', '.join(_MODELS)}, got {short_repr(kind)}"
        )
    size = size_from_width_height(
        [entry(values, key, where) for key in ("image_width", "image_height")],
        f"{where}, image_width and image_height",
    )

    def get(section: str, *keys: str) -> list[float]:
        inside = f"{where}, {section}"
        return [number(entry(values, section, where), key, inside) for key in keys]

    def focal(*keys: str) -> torch.Tensor:
        found = focal_lengths(get("projection_parameters", *keys), f"{where}, {' and '.join(keys)}")
        return torch.tensor(found, dtype=torch.float64)

    with errors_of_file(where):
        if kind.upper() == "KANNALA_BRANDT":
            coefficients = get("projection_parameters", "k2", "k3", "k4", "k5")
            center = get("projection_parameters", "u0", "v0")
            return KannalaBrandtCamera(focal("mu", "mv"), center, coefficients, size, math.pi)
        coefficients = get("distortion_parameters", "k1", "k2", "p1", "p2")
        if kind.upper() == "PINHOLE":
            center = get("projection_parameters", "cx", "cy")
            return BrownConradyCamera(focal("fx", "fy"), center, coefficients, size)
        center = get("projection_parameters", "u0", "v0")
        xi = get("mirror_parameters", "xi")[0]
        return UnifiedCamera(focal("gamma1", "gamma2"), center, xi, [*coefficients, 0.0], size)


def kitti360_contents(path: Path, options: Options) -> Contents:
    """The fisheyes of KITTI-360's folder ``calibration``, from its ``calib_cam_to_pose.txt``.

    Raises:
        MissingFileError: no camera that has a pose has a file ``image_0?.yaml``.
        FileFormatError: a file is broken; the message names line or key.
    """
    cameras: dict[str, Camera] = {}
    poses = []
    for line, (label, *words) in data_lines(path):
        name = label.rstrip(":")
        pose = transform_from_rows(words, f"{path}, line {line}, {name}")
        file = path.parent / f"{part_of_name(name)}.yaml"
        if not file.is_file():
            continue  # the perspective pair has other files
        content = load(file)
        if not isinstance(content, dict) or not recognizes(content):
            raise FileFormatError(
                f"{file}: expected model_type, mirror_parameters and so on, found none of them"
            )
        cameras[name] = next(iter(contents(content, file, options).cameras.values()))
        poses.append(pose)
    if not cameras:
        raise MissingFileError(
            f"{path}: none of its cameras has a file image_02.yaml, image_03.yaml beside it"
        )
    return Contents(cameras, torch.stack(poses))


register_format(
    FileFormat(
        "camodocal",
        "KITTI-360 and other camodocal yaml",
        recognizes_keys=recognizes,
        contents_of_keys=contents,
        recognizes_file=lambda path: path.name == KITTI360_POSES,
        contents_of_file=kitti360_contents,
        usual_names=(KITTI360_POSES,),
    )
)
