# SPDX-License-Identifier: Apache-2.0
"""Write a camera or a rig in a format of the caller's choice."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

from sphericalvision.cameras.base import Camera, check_single
from sphericalvision.cameras.calibration.formats import FileFormat, file_format, file_formats
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import ArgumentError, check_choice, check_type


def camera_formats() -> tuple[str, ...]:
    """Names of the formats in which ``save_camera`` writes.

    Examples:
        >>> "kalibr" in camera_formats()
        True
    """
    return tuple(format.name for format in file_formats() if format.write_camera)


def rig_formats() -> tuple[str, ...]:
    """Names of the formats in which ``save_rig`` writes.

    Examples:
        >>> "omnimvs" in rig_formats()
        True
    """
    return tuple(format.name for format in file_formats() if format.write_rig)


def save_camera(camera: Camera, path: str | Path, format: str | None = None) -> None:
    """Write one camera, which ``read_camera`` reads back.

    Args:
        camera: a single camera of a model that the format has; each format's page says which.
        path: the file, replaced at once when everything is written.
        format: ``"native"`` (this package's own YAML, also when ``None``), or another one of
            ``sphericalvision.cameras.calibration.CAMERA_FORMATS``, such as ``"kalibr"``. The name of the file has no
            say in it.

    Raises:
        ArgumentError: an unknown format, a batch, or a model that the format does not have; the message names formats
            that have it. ``convert(camera, to=...)`` fits another model.

    Examples:
        >>> import tempfile
        >>> from sphericalvision.cameras import PinholeCamera, read_camera
        >>> camera = PinholeCamera([300.0, 300.0], [159.5, 119.5], (240, 320))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_camera(camera, f"{folder}/cameras.txt", format="colmap")
        ...     read_camera(f"{folder}/cameras.txt").principal_point
        tensor([159.5000, 119.5000])
    """
    chosen = _format(format, camera_formats)
    check_type("camera", camera, Camera)
    check_single(camera)
    assert chosen.write_camera is not None
    chosen.write_camera(camera, Path(path))


def save_rig(rig: CameraRig, path: str | Path, format: str | None = None) -> None:
    """Write a rig to a calibration file, which ``read_rig`` reads back.

    Args:
        rig: a single rig of cameras whose models the format has; each format's page says which.
        path: the file, replaced only after everything is written; or a folder, if the format has a file for each
            camera.
        format: ``"native"`` (this package's own YAML, also when ``None``), or another one of
            ``sphericalvision.cameras.calibration.RIG_FORMATS``, such as ``"kalibr"``.

    Raises:
        ArgumentError: an unknown format, a batch, or a model that the format does not have; the message names formats
            that have it. ``convert(camera, to=...)`` fits another model.

    Examples:
        >>> from sphericalvision.cameras import read_rig, ring_rig
        >>> save_rig(ring_rig(2), "rig.yaml")
        >>> read_rig("rig.yaml").names
        ['cam1', 'cam2']
    """
    chosen = _format(format, rig_formats)
    check_type("rig", rig, CameraRig)
    check_single(rig)
    assert chosen.write_rig is not None
    chosen.write_rig(rig.in_world(), Path(path))
    if rig.masks and not chosen.holds_masks:
        with_masks = [name for name in rig_formats() if file_format(name).holds_masks]
        warnings.warn(
            f"{path}: the format {format!r} holds no masks, those of {', '.join(rig.masks)} are not written "
            f"({', '.join(with_masks)} hold them)",
            stacklevel=2,
        )


def _format(format: str | None, formats: Callable[[], tuple[str, ...]]) -> FileFormat:
    """The format of a name among ``formats``; the package's own needs none of the others."""
    format = format or "native"
    if format == "native":
        return file_format(format)
    written = formats()
    for other in file_formats():
        names = f"{other.name} {other.title}".lower().split()
        if isinstance(format, str) and format not in written and format.lower() in names:
            raise ArgumentError(
                f"format: expected one of {', '.join(written)}, got {format!r}; files of {other.title} are read, and "
                "not written in this form"
            )
    check_choice("format", format, written)
    return file_format(format)
