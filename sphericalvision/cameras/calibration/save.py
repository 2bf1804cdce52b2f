# SPDX-License-Identifier: Apache-2.0
"""Write a camera or a rig in a format of the caller's choice."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

from sphericalvision.cameras.base import Camera, check_single
from sphericalvision.cameras.calibration.basalt import write_basalt
from sphericalvision.cameras.calibration.colmap import write_colmap
from sphericalvision.cameras.calibration.kalibr import write_kalibr
from sphericalvision.cameras.calibration.native import write_camera, write_rig
from sphericalvision.cameras.calibration.ocam_text import write_ocam_text
from sphericalvision.cameras.calibration.omnimvs import write_omnimvs
from sphericalvision.cameras.calibration.opencv_writer import write_opencv
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import check_choice

__all__ = ["CAMERA_FORMATS", "RIG_FORMATS", "save_camera", "save_rig"]

_CAMERA_WRITERS: dict[str, Callable[[Camera, Path], None]] = {
    "native": write_camera,
    "ocamcalib": write_ocam_text,
    "basalt": write_basalt,
    "kalibr": write_kalibr,
    "opencv": write_opencv,
    "colmap": write_colmap,
}
_RIG_WRITERS: dict[str, Callable[[CameraRig, Path], None]] = {
    "native": write_rig,
    "omnimvs": write_omnimvs,
    "basalt": write_basalt,
    "kalibr": write_kalibr,
    "opencv": write_opencv,
}
_WITH_MASKS = ("native", "omnimvs", "basalt")

CAMERA_FORMATS = tuple(_CAMERA_WRITERS)
RIG_FORMATS = tuple(_RIG_WRITERS)


def save_camera(camera: Camera, path: str | Path, format: str | None = None) -> None:
    """Write one camera, which ``read_camera`` reads back.

    Args:
        camera: a single camera of a model that the format has; each format's page says which.
        path: the file, replaced at once when everything is written.
        format: ``"native"`` (this package's own YAML, also when ``None``), ``"ocamcalib"``, ``"basalt"``, ``"kalibr"``,
            ``"opencv"`` or ``"colmap"``. The name of the file has no say in it.

    Raises:
        ArgumentError: an unknown format, a batch, or a model that the format does not have; the message names formats
            that have it. ``camera.convert(to=...)`` fits another model.

    Examples:
        >>> import tempfile
        >>> from sphericalvision.cameras import PinholeCamera, read_camera
        >>> camera = PinholeCamera([300.0, 300.0], [159.5, 119.5], (240, 320))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_camera(camera, f"{folder}/cameras.txt", format="colmap")
        ...     read_camera(f"{folder}/cameras.txt").principal_point
        tensor([159.5000, 119.5000])
    """
    format = format or "native"
    check_choice("format", format, CAMERA_FORMATS)
    check_single(camera)
    _CAMERA_WRITERS[format](camera, Path(path))


def save_rig(rig: CameraRig, path: str | Path, format: str | None = None) -> None:
    """Write a rig, which ``read_rig`` reads back.

    Args:
        rig: a single rig of cameras whose models the format has; each format's page says which.
        path: the file, replaced at once when everything is written.
        format: ``"native"`` (this package's own YAML, also when ``None``), ``"omnimvs"``, ``"basalt"``, ``"kalibr"`` or
            ``"opencv"`` (two cameras). COLMAP's file has no poses: ``write_colmap`` of
            ``sphericalvision.cameras.calibration`` writes ``rig.cameras`` to it.

    Raises:
        ArgumentError: an unknown format, a batch, or a model that the format does not have; the message names formats
            that have it. ``camera.convert(to=...)`` fits another model.
    """
    format = format or "native"
    check_choice("format", format, RIG_FORMATS)
    check_single(rig)
    _RIG_WRITERS[format](rig, Path(path))
    if rig.masks and format not in _WITH_MASKS:
        warnings.warn(
            f"{path}: the format {format!r} holds no masks, those of {', '.join(rig.masks)} are not written "
            f"({', '.join(_WITH_MASKS)} hold them)",
            stacklevel=2,
        )
