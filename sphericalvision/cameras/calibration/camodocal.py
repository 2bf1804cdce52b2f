# SPDX-License-Identifier: Apache-2.0
"""Camodocal's YAML, which KITTI-360 and VINS use: Mei, pinhole, Kannala-Brandt and OCam cameras.

Convention:
    One file is one camera. KITTI-360's fisheyes are ``image_02.yaml`` and ``image_03.yaml``; their poses stand in
    ``calib_cam_to_pose.txt`` beside them, camera to the vehicle's GPS/IMU frame (x forward, y right, z down), in
    metres.

    ``SCARAMUZZA`` has OCam's polynomials with (u, v) in the places of (row, column): u = ac x + ad y + cx and
    v = ae x + y + cy, where z = -(p0 + p1 r + ... + p4 r⁴) of r = hypot(x, y). Our ideal image is ac times as large.

References:
    Y. Liao, J. Xie, A. Geiger, "KITTI-360", PAMI 45 (2023); C. Mei, P. Rives, "Single view point omnidirectional
    camera calibration from planar grids", ICRA 2007.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Calibration, Options
from sphericalvision.cameras.calibration.formats import FileFormat
from sphericalvision.cameras.calibration.keys import SETTINGS, Keys, check_understood
from sphericalvision.cameras.calibration.lenses import Lens, lens_called
from sphericalvision.cameras.calibration.ocam_text import make_ocam
from sphericalvision.cameras.calibration.poses import transform_from_rows
from sphericalvision.cameras.calibration.text_files import data_lines, load_keys
from sphericalvision.core import FileFormatError, MissingFileError
from sphericalvision.io.files import part_of_name

KITTI360_POSES = "calib_cam_to_pose.txt"
_LENSES = (
    Lens("MEI", "unified", "xi k1 k2 p1 p2 gamma1=fx gamma2=fy u0=cx v0=cy", zeros="k3"),
    Lens("PINHOLE", "brown_conrady", "k1 k2 p1 p2 fx fy cx cy"),
    Lens("KANNALA_BRANDT", "kannala_brandt", "k2=k1 k3=k2 k4=k3 k5=k4 mu=fx mv=fy u0=cx v0=cy"),
)
_OCAM = "SCARAMUZZA"
_KINDS = (*(lens.name for lens in _LENSES), _OCAM)
_SECTIONS = ("mirror_parameters", "projection_parameters", "distortion_parameters", "poly_parameters")


IGNORED = (
    SETTINGS + "(?!image|camera|model|mirror|distortion|projection|poly|affine|lens|fisheye(?!_mask$|$))[^/]*"
)
"""Settings of the programs that have cameras in their own file; not keys of a lens."""


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file is a camera of camodocal, or several by name."""
    if "model_type" in content or any(key in content for key in _SECTIONS):
        return True
    cameras = [value for value in content.values() if isinstance(value, dict)]
    return bool(cameras) and all(recognizes(value) for value in cameras)


def read(content: Keys, calibration: Calibration) -> None:
    """The camera of a parsed file, called by its ``camera_name``; or several cameras by name."""
    if "model_type" in content or any(key in content for key in _SECTIONS):
        name = str(content.get("camera_name") or calibration.path.stem)
        calibration.add(name, _camera(content), content.where)
        return
    for name, values in content.items():
        if isinstance(values, Keys):
            calibration.add(str(name), _camera(content.inner(name)), values.where)


def _camera(values: Keys) -> Camera:
    kind = values.model("model_type", _KINDS)
    if kind == _OCAM:
        return _ocam(values)
    lens = lens_called(_LENSES, kind)
    size = values.size("image_width", "image_height")
    intrinsics = []
    for key, name in zip(lens.keys, lens.names, strict=True):
        section = "mirror" if name == "xi" else "distortion"
        if name in ("fx", "fy", "cx", "cy") or lens.name == "KANNALA_BRANDT":
            section = "projection"
        intrinsics.append(values.inner(f"{section}_parameters").number(key))
    return lens.camera(intrinsics, size, values.where)


def _ocam(values: Keys) -> Camera:
    polynomial, affine = values.inner("poly_parameters"), values.inner("affine_parameters")
    direct = [polynomial.number(f"p{power}") for power in range(5)]
    ac, ad, ae, cx, cy = (affine.number(key) for key in ("ac", "ad", "ae", "cx", "cy"))
    size = values.size("image_width", "image_height")
    # inv_poly_parameters are a fit to what is inverted exactly here
    return make_ocam(direct, None, [cx, cy], [ac, ad, ae], size, affine.where, of_columns=True)


def camera_in(file: Path) -> Camera:
    """The camera of a file that another one names, or the first one in it."""
    content = load_keys(file, "model_type, mirror_parameters and so on")
    if not recognizes(content):
        raise FileFormatError(f"{file}: expected model_type, mirror_parameters and so on, found none of them")
    calibration = Calibration(Options(max_angle=math.pi), file)
    read(content, calibration)
    check_understood(content, str(file), IGNORED)
    return next(iter(calibration.cameras.values()))


def read_kitti360(path: Path, calibration: Calibration) -> None:
    """The fisheyes of KITTI-360's folder ``calibration``, from its ``calib_cam_to_pose.txt``."""
    for line, (label, *words) in data_lines(path):
        name = label.rstrip(":")
        pose = transform_from_rows(words, f"{path}, line {line}, {name}")
        file = path.parent / f"{part_of_name(name)}.yaml"
        if file.is_file():  # the perspective pair has other files
            calibration.add(name, camera_in(file), str(file), pose)
    if not calibration.cameras:
        raise MissingFileError(
            f"{path}: none of its cameras has a file image_02.yaml, image_03.yaml beside it"
        )


FileFormat(
    "camodocal",
    "KITTI-360 and other camodocal yaml",
    recognizes_keys=recognizes,
    read_keys=read,
    ignored=IGNORED,
    recognizes_file=lambda path: path.name == KITTI360_POSES,
    read_file=read_kitti360,
    usual_names=(KITTI360_POSES,),
).register()
