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

from pathlib import Path
from typing import Any

import torch

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Contents, Options
from sphericalvision.cameras.calibration.files import data_lines, load_keys
from sphericalvision.cameras.calibration.formats import FileFormat, register_format
from sphericalvision.cameras.calibration.keys import SETTINGS, check_understood
from sphericalvision.cameras.calibration.lenses import Lens, lens_called
from sphericalvision.cameras.calibration.parsing import (
    chosen_model,
    entry,
    number,
    size_from_width_height,
)
from sphericalvision.cameras.calibration.poses import transform_from_rows
from sphericalvision.cameras.calibration.visible_part import bounded
from sphericalvision.core import FileFormatError, MissingFileError
from sphericalvision.io.files import part_of_name

__all__ = ["KITTI360_POSES", "camera_in", "contents", "kitti360_contents", "recognizes"]

KITTI360_POSES = "calib_cam_to_pose.txt"
_LENSES = (
    Lens("MEI", "unified", "xi k1 k2 p1 p2 gamma1=fx gamma2=fy u0=cx v0=cy", zeros="k3"),
    Lens("PINHOLE", "brown_conrady", "k1 k2 p1 p2 fx fy cx cy"),
    Lens("KANNALA_BRANDT", "kannala_brandt", "k2=k1 k3=k2 k4=k3 k5=k4 mu=fx mv=fy u0=cx v0=cy"),
)
_KINDS = tuple(lens.name for lens in _LENSES)
_SECTIONS = ("mirror_parameters", "projection_parameters", "distortion_parameters")


IGNORED = SETTINGS + "(?!image|camera|model|mirror|distortion|projection|lens|fisheye(?!_mask$|$))[^/]*"
"""Settings of the programs that have cameras in their own file; not keys of a lens."""


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file is a camera of camodocal, or several by name."""
    if "model_type" in content or any(key in content for key in _SECTIONS):
        return True
    cameras = [value for value in content.values() if isinstance(value, dict)]
    return bool(cameras) and all(recognizes(value) for value in cameras)


def contents(content: dict[str, Any], path: Path, options: Options) -> Contents:
    """The camera of a parsed file, called by its ``camera_name``; or several cameras by name."""
    if "model_type" in content or any(key in content for key in _SECTIONS):
        camera = bounded(_camera(content, str(path)), options.max_angle, str(path))
        return Contents({str(content.get("camera_name") or path.stem): camera})
    named = {str(name): content[name] for name, value in content.items() if isinstance(value, dict)}
    return Contents(
        {
            name: bounded(_camera(value, f"{path}, {name}"), options.max_angle, f"{path}, {name}")
            for name, value in named.items()
        }
    )


def _camera(values: dict[str, Any], where: str) -> Camera:
    kind = chosen_model(entry(values, "model_type", where), _KINDS, f"{where}, model_type")
    size = size_from_width_height(
        [entry(values, key, where) for key in ("image_width", "image_height")],
        f"{where}, image_width and image_height",
    )
    lens = lens_called(_LENSES, kind)
    found = []
    for key, name in zip(lens.keys, lens.names, strict=True):
        section = "mirror" if name == "xi" else "distortion"
        if name in ("fx", "fy", "cx", "cy") or kind == "KANNALA_BRANDT":
            section = "projection"
        section += "_parameters"
        found.append(number(entry(values, section, where), key, f"{where}, {section}"))
    return lens.camera(found, size, where)


def camera_in(file: Path, options: Options) -> Camera:
    """The camera of a file that another one names."""
    content = load_keys(file, "model_type, mirror_parameters and so on")
    if not recognizes(content):
        raise FileFormatError(f"{file}: expected model_type, mirror_parameters and so on, found none of them")
    found = contents(content, file, options)
    check_understood(content, str(file), IGNORED)
    return next(iter(found.cameras.values()))


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
        cameras[name] = camera_in(file, options)
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
        ignored=IGNORED,
        recognizes_file=lambda path: path.name == KITTI360_POSES,
        contents_of_file=kitti360_contents,
        usual_names=(KITTI360_POSES,),
    )
)
