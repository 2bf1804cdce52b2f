# SPDX-License-Identifier: Apache-2.0
"""Read a camera or a rig from any known calibration, recognised by its content."""

from __future__ import annotations

from pathlib import Path

import torch

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration import (
    basalt,
    camodocal,
    colmap,
    kalibr,
    multicol,
    native,
    omnimvs,
    opencv,
    woodscape,
)
from sphericalvision.cameras.calibration.contents import Contents, Options
from sphericalvision.cameras.calibration.files import data_lines, load, looks_structured
from sphericalvision.cameras.calibration.ocam_text import read_ocam_folder, read_ocam_text
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import ArgumentError, FileFormatError, MissingFileError

__all__ = ["read_camera", "read_cameras", "read_rig"]

_FORMATS = (native, omnimvs, basalt, kalibr, multicol, camodocal, woodscape, opencv)
"""Formats of keys with values; the first that recognises a file reads it."""

_KNOWN = (
    "known are OCamCalib text, a folder with ocam*.txt and poses.txt, OmniMVS config.yaml, Basalt json, Kalibr "
    "camchain, OpenCV FileStorage, COLMAP cameras.txt, KITTI-360 and other camodocal yaml, WoodScape json, "
    "Lafida/MultiCol yaml, and the package's own YAML (save_camera, save_rig)"
)
_FILES_OF_FOLDERS = (
    "config.yaml",
    "poses.txt",
    "calibration.json",
    "rig.yaml",
    "camchain.yaml",
    camodocal.KITTI360_POSES,
    multicol.MULTICOL_POSES,
    "extrinsics.yml",
    "cameras.txt",
)


def read_rig(
    path: str | Path,
    *,
    translation_unit: str | None = None,
    max_angle: float | None = None,
    image_size: tuple[int, int] | None = None,
    dtype: torch.dtype | None = None,
) -> CameraRig:
    """The rig of a calibration, whose format is recognised by its content; poses are metres, camera to rig.

    Args:
        path: an OmniMVS ``config.yaml``; a folder with ``ocam*.txt`` and ``poses.txt``; a Basalt json (with
            ``cam0/mask.png``, ... beside it, if there are masks); a Kalibr camchain; an OpenCV FileStorage of two
            cameras; KITTI-360's ``calib_cam_to_pose.txt``; a WoodScape json; Lafida's
            ``MultiCamSys_Calibration.yaml``; the package's own YAML; or a folder that holds exactly one of these under
            its usual name, or WoodScape's files.
        translation_unit: ``"m"``, ``"cm"`` or ``"mm"``: required for ``poses.txt`` and OpenCV's files, which do not
            tell. All other formats are in metres.
        max_angle: half the field of view in radians, for all cameras, instead of what the file tells or, where it does
            not, of the angle at the farthest pixel of the image.
        image_size: (height, width) of the images, for OpenCV's files that do not tell.
        dtype: of intrinsics and poses, by default torch's default.

    Raises:
        MissingFileError: there is nothing at ``path``.
        FileFormatError: the format is unknown, the file is broken, or has no poses; the message names line or key.
        ArgumentError: ``translation_unit`` is missing, or given for a format that is in metres.
    """
    options = Options(max_angle, dtype, translation_unit, image_size)
    path, found = _contents(Path(path), options)
    return found if isinstance(found, CameraRig) else found.rig(path, dtype)


def read_cameras(
    path: str | Path,
    *,
    max_angle: float | None = None,
    image_size: tuple[int, int] | None = None,
    dtype: torch.dtype | None = None,
) -> dict[str, Camera]:
    """All cameras of a calibration by name, whether it has poses or not; arguments and errors are ``read_rig``'s."""
    options = Options(max_angle, dtype, "m", image_size)  # positions are not looked at, so any unit will do
    found = _contents(Path(path), options)[1]
    return found.cameras if isinstance(found, CameraRig) else found.cast(dtype)


def read_camera(
    path: str | Path,
    name: str | None = None,
    *,
    max_angle: float | None = None,
    image_size: tuple[int, int] | None = None,
    dtype: torch.dtype | None = None,
) -> Camera:
    """The camera of a calibration that has one, or one of several by name.

    Args:
        path: a file or folder of any format that ``read_rig`` knows, or one of a single camera: OCamCalib's text file,
            COLMAP's ``cameras.txt``, KITTI-360's ``image_02.yaml``, Lafida's ``InteriorOrientationFisheye0.yaml``.
        name: which one, where there are several: ``cam0``, ``cam1``, ... or as the file says.
        max_angle: half the field of view in radians, instead of what the file tells or, where it does not, of the angle
            at the farthest pixel of the image.
        image_size: (height, width) of the images, for OpenCV's files that do not tell.
        dtype: of the intrinsics, by default torch's default.

    Raises:
        MissingFileError: there is nothing at ``path``.
        FileFormatError: the format is unknown, or the file is broken; the message names line or key.
        ArgumentError: there are several cameras and no ``name``, or none of that name.
    """
    cameras = read_cameras(path, max_angle=max_angle, image_size=image_size, dtype=dtype)
    if name is None and len(cameras) == 1:
        return next(iter(cameras.values()))
    if name not in cameras:
        problem = f"holds {len(cameras)} cameras" if name is None else f"has no camera {name!r}"
        raise ArgumentError(
            f"name: {path} {problem}; choose one of {', '.join(cameras)}, or use read_rig or read_cameras for all"
        )
    return cameras[name]


def _contents(path: Path, options: Options) -> tuple[Path, Contents | CameraRig]:
    """The file that was read, and what it holds."""
    path, parts = _calibration_file(path)
    if parts:
        return path, woodscape.joined([(part, _of_keys(part, options)) for part in parts])
    if path.name == "poses.txt":
        return path, read_ocam_folder(
            path.parent,
            translation_unit=options.translation_unit,
            max_angle=options.max_angle,
            dtype=options.dtype,
        )
    if looks_structured(path):
        return path, _of_keys(path, options)
    _refuse_unit(path, options)
    if path.name == camodocal.KITTI360_POSES:
        return path, camodocal.kitti360_contents(path, options)
    if colmap.recognizes(path):
        return path, colmap.contents(path, options)
    _refuse_keys(path)
    camera = read_ocam_text(path, max_angle=options.max_angle, dtype=torch.float64)
    return path, Contents({path.stem: camera})


def _of_keys(path: Path, options: Options) -> Contents:
    content = load(path)
    if isinstance(content, dict):
        for reader in _FORMATS:
            if reader.recognizes(content):
                if reader is not opencv:
                    _refuse_unit(path, options)
                return reader.contents(content, path, options)
    raise FileFormatError(f"{path}: not a calibration; {_KNOWN}")


def _refuse_keys(path: Path) -> None:
    """Lines of ``key: values`` are KITTI's; OCamCalib's are numbers."""
    lines = data_lines(path)
    if lines and lines[0][1][0].endswith(":"):
        raise FileFormatError(
            f"{path}, line {lines[0][0]}: {lines[0][1][0]} is no line of an OCamCalib file. KITTI's "
            "calib_cam_to_cam.txt and the like are not read: pass K_0x and D_0x to BrownConradyCamera, or for "
            f"rectified images P_rect_0x to PinholeCamera; {_KNOWN}"
        )


def _refuse_unit(path: Path, options: Options) -> None:
    if options.translation_unit not in (None, "m"):
        raise ArgumentError(
            f"translation_unit: {path} is in metres by its format, got {options.translation_unit!r}; only poses.txt "
            "and OpenCV's files need a unit"
        )


def _calibration_file(path: Path) -> tuple[Path, list[Path]]:
    """The file itself, or the one calibration in a folder; with it the files of a rig that has one for each camera."""
    if path.is_file():
        return path, []
    if not path.is_dir():
        raise MissingFileError(f"{path}: no such file or folder (a calibration was expected; {_KNOWN})")
    found = [path / name for name in _FILES_OF_FOLDERS if (path / name).is_file()]
    if not found:
        parts = [part for part in sorted(path.glob("*.json")) if _is_woodscape(part)]
        if parts:
            return path, parts
        hint = "; ocam*.txt are there, but no poses.txt" if any(path.glob("ocam*.txt")) else ""
        raise MissingFileError(
            f"{path}: none of {', '.join(_FILES_OF_FOLDERS)} in this folder{hint}; {_KNOWN}"
        )
    if len(found) > 1:
        raise ArgumentError(
            f"path: {path} holds {' and '.join(file.name for file in found)}, which may differ in scale; name the one "
            "to read"
        )
    return found[0], []


def _is_woodscape(path: Path) -> bool:
    content = load(path)
    return isinstance(content, dict) and woodscape.recognizes(content)
