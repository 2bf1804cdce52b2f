# SPDX-License-Identifier: Apache-2.0
"""The registry of file formats: how each is recognised, read and written, told by its own module."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Calibration
from sphericalvision.cameras.calibration.keys import Keys
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.extensions import Registry

ENTRY_POINTS = "sphericalvision.formats"
"""Group of entry points, name -> ``FileFormat``, in which other packages offer theirs."""


@dataclass(frozen=True)
class FileFormat:
    """What a module of ``calibration/`` says of its format; readers and writers are there if it has them.

    A file of keys with values (YAML, JSON, OpenCV's XML) is parsed once, to ``Keys``, and offered to all formats; any
    other file is offered as it is. Readers raise ``FileFormatError`` where a key or a line is missing or makes no
    sense, and name file and key or line; writers raise ``ArgumentError`` for what the format cannot hold, and name what
    does.
    """

    name: str
    """As in ``save_camera(format=...)``."""
    title: str
    """In messages: the program and its file."""
    recognizes_keys: Callable[[dict[str, Any]], bool] | None = None
    """Whether parsed keys with values are of this format; at most one format says so of a whole file."""
    read_keys: Callable[[Keys, Calibration], None] | None = None
    ignored: str = ".*"
    """Keys that do not matter, as ``check_understood`` has them; any other key that is not read is refused."""
    recognizes_file: Callable[[Path], bool] | None = None
    """The same of a file that is no such thing, by its name or content."""
    read_file: Callable[[Path, Calibration], None] | None = None
    usual_names: tuple[str, ...] = ()
    """By which its file is found in a folder, the first one that is there."""
    files_of_rig: Callable[[Path], list[Path]] | None = None
    """The files of a folder that are a rig together, one for each camera."""
    tells_unit: bool = True
    """Whether translations are metres, or the file says what they are."""
    models: tuple[str, ...] = ()
    """Names of the camera models that are written; none means every model."""
    write_camera: Callable[[Camera, Path], None] | None = None
    write_rig: Callable[[CameraRig, Path], None] | None = None
    models_with_skew: tuple[str, ...] = ()
    """Names of the camera models that are written with a skew."""
    holds_masks: bool = False

    def register(self) -> None:
        """Make the format known to ``read_camera``, ``read_rig``, ``save_camera`` and ``save_rig``.

        A package that others install names its formats as entry points of the group ``sphericalvision.formats``
        instead.

        Raises:
            ArgumentError: another format has its name.
        """
        FORMATS.add(self.name, self)


FORMATS: Registry[FileFormat] = Registry(
    "format",
    "a FileFormat that has its name",
    lambda name, format: isinstance(format, FileFormat) and format.name == name,
    ENTRY_POINTS,
    folder="sphericalvision.cameras.calibration",
)


def has_all(*keys: str) -> Callable[[dict[str, Any]], bool]:
    """Whether a parsed file has all of these keys, for ``FileFormat.recognizes_keys``."""
    return lambda content: all(key in content for key in keys)


def has_any(*keys: str) -> Callable[[dict[str, Any]], bool]:
    """The same for one of them."""
    return lambda content: any(key in content for key in keys)


def file_formats() -> Iterator[FileFormat]:
    """All formats, the package's own first; the others are imported once somebody asks for a second one."""
    yield file_format("native")
    yield from (format for format in FORMATS.all() if format.name != "native")


def file_format(name: str) -> FileFormat:
    """The format of a name that is known."""
    format = FORMATS.find(name)
    assert format is not None
    return format


def known_formats() -> str:
    """The end of messages about files of no known format."""
    return f"known are {', '.join(format.title for format in file_formats())}"
