# SPDX-License-Identifier: Apache-2.0
"""Read a camera or a rig from any known calibration, recognised by its content."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
import yaml

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.basalt import read_basalt
from sphericalvision.cameras.calibration.native import (
    CAMERA_FORMAT,
    RIG_FORMAT,
    camera_from_dict,
    rig_from_dict,
)
from sphericalvision.cameras.calibration.ocam_text import read_ocam_folder, read_ocam_text
from sphericalvision.cameras.calibration.omnimvs import rig_from_omnimvs
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import ArgumentError, FileFormatError, MissingFileError, check_file

__all__ = ["read_camera", "read_rig"]

_KNOWN = (
    "known are an OmniMVS config.yaml, a folder with ocam*.txt and poses.txt, a Basalt json and the package's own YAML "
    "(CameraRig.to_yaml)"
)


def read_rig(
    path: str | Path,
    *,
    translation_unit: str | None = None,
    max_angle: float | None = None,
    dtype: torch.dtype | None = None,
) -> CameraRig:
    """The rig of a calibration, whose format is recognised by its content; poses are metres, camera to rig.

    Args:
        path: an OmniMVS ``config.yaml``; a folder with ``ocam*.txt`` and ``poses.txt``; a Basalt json (with
            ``cam0/mask.png``, ... beside it, if there are masks); the package's own YAML; or a folder that holds
            exactly one of these as ``config.yaml``, ``poses.txt``, ``calibration.json`` or ``rig.yaml``.
        translation_unit: ``"m"``, ``"cm"`` or ``"mm"``: required for ``poses.txt``, which does not tell. All other
            formats are in metres.
        max_angle: half the field of view in radians, for all cameras, instead of what the file tells or implies.
        dtype: of intrinsics and poses, by default torch's default.

    Raises:
        MissingFileError: there is nothing at ``path``.
        FileFormatError: the format is unknown, or the file is broken; the message names line or key.
        ArgumentError: ``translation_unit`` is missing, or given for a format that is in metres.
    """
    path = _calibration_file(Path(path))
    if path.name == "poses.txt":
        return read_ocam_folder(
            path.parent, translation_unit=translation_unit, max_angle=max_angle, dtype=dtype
        )
    if translation_unit not in (None, "m"):
        raise ArgumentError(
            f"translation_unit: {path} is in metres by its format, got {translation_unit!r}; "
            "only poses.txt needs a unit"
        )
    if path.suffix == ".json":
        return read_basalt(path, max_angle=max_angle, dtype=dtype)
    if path.suffix == ".txt":
        raise FileFormatError(
            f"{path}: one OCamCalib file is one camera, not a rig: use read_camera, or give the folder with "
            "ocam*.txt and poses.txt"
        )
    content = _load_yaml(path)
    if isinstance(content, dict) and content.get("format") == RIG_FORMAT:
        rig = rig_from_dict(content, path, dtype)
        if max_angle is None:
            return rig
        cameras = {name: camera.with_max_angle(max_angle) for name, camera in rig.cameras.items()}
        return CameraRig(cameras, rig.world_from_camera, rig.masks)
    if isinstance(content, dict) and "cameras" in content:
        return rig_from_omnimvs(content, path, max_angle=max_angle, dtype=dtype)
    if isinstance(content, dict) and "cam0" in content:
        raise FileFormatError(f"{path}: Kalibr's camchain format is not supported yet; {_KNOWN}")
    raise FileFormatError(f"{path}: not a calibration of a rig; {_KNOWN}")


def read_camera(
    path: str | Path, *, max_angle: float | None = None, dtype: torch.dtype | None = None
) -> Camera:
    """A single camera from an OCamCalib text file or from the package's own YAML.

    Args:
        path: the file.
        max_angle: half the field of view in radians, instead of what the file tells or, for OCamCalib, of the angle at
            the farthest pixel of the image.
        dtype: of the intrinsics, by default torch's default.

    Raises:
        MissingFileError: there is no such file.
        FileFormatError: it is neither, or broken; the message names line or key.
    """
    path = check_file(path, "an OCamCalib text file or a camera YAML")
    if path.suffix == ".json":
        raise FileFormatError(f"{path}: a json holds a rig: use read_rig(path).cameras")
    if path.suffix not in (".yaml", ".yml"):
        return read_ocam_text(path, max_angle=max_angle, dtype=dtype)
    content = _load_yaml(path)
    if not isinstance(content, dict) or content.get("format") != CAMERA_FORMAT:
        raise FileFormatError(
            f"{path}: expected `format: {CAMERA_FORMAT}`; a file of several cameras is for read_rig"
        )
    camera = camera_from_dict(content, str(path), dtype)
    return camera if max_angle is None else camera.with_max_angle(max_angle)


def _calibration_file(path: Path) -> Path:
    """The file itself, or the one calibration in a folder."""
    if path.is_file():
        return path
    if not path.is_dir():
        raise MissingFileError(f"{path}: no such file or folder (a calibration was expected; {_KNOWN})")
    names = ("config.yaml", "poses.txt", "calibration.json", "rig.yaml")
    found = [path / name for name in names if (path / name).is_file()]
    if not found:
        hint = "; ocam*.txt are there, but no poses.txt" if any(path.glob("ocam*.txt")) else ""
        raise MissingFileError(f"{path}: none of {', '.join(names)} in this folder{hint}; {_KNOWN}")
    if len(found) > 1:
        raise ArgumentError(
            f"path: {path} holds {' and '.join(file.name for file in found)}, which may differ in scale; name the one "
            "to read"
        )
    return found[0]


def _load_yaml(path: Path) -> Any:
    try:
        text = path.read_text(encoding="utf-8")
        if text.startswith("%YAML:1.0") or text.lstrip().startswith("<?xml"):
            raise FileFormatError(f"{path}: OpenCV's FileStorage format is not supported yet; {_KNOWN}")
        return yaml.safe_load(text)
    except UnicodeDecodeError:
        raise FileFormatError(f"{path}: expected a text file, got binary data; {_KNOWN}") from None
    except yaml.YAMLError as error:
        raise FileFormatError(f"{path}: not valid YAML ({' '.join(str(error).split())})") from None
