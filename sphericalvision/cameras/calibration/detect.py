# SPDX-License-Identifier: Apache-2.0
"""Read a camera or a rig from any known calibration, recognised by its content."""

from __future__ import annotations

import itertools
import re
import warnings
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from pathlib import Path

import torch

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Calibration, Options, joined
from sphericalvision.cameras.calibration.formats import FileFormat, file_formats, known_formats
from sphericalvision.cameras.calibration.keys import Keys, check_understood
from sphericalvision.cameras.calibration.text_files import STRUCTURED, load, looks_structured
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import ArgumentError, FileFormatError, MissingFileError, check_type
from sphericalvision.io.files import read_text


def read_rig(
    path: str | Path,
    *,
    translation_unit: str | None = None,
    max_angle: float | None = None,
    image_size: tuple[int, int] | None = None,
    dtype: torch.dtype | None = None,
) -> CameraRig:
    """Read a rig from a calibration file, whose format is recognised by its content; poses are metres, camera to rig.

    Args:
        path: a file of any format in the documentation's table of calibration files that has poses; or a folder that
            holds exactly one of these under its usual name, or a file for each camera (WoodScape, EuRoC's ``mav0``).
        translation_unit: ``"m"``, ``"cm"`` or ``"mm"``: required for ``poses.txt`` and OpenCV's files, which do not
            state it. All other formats are in metres.
        max_angle: half the field of view in radians, for all cameras. By default that of the file or, if it states
            none, the angle at the farthest pixel of the image.
        image_size: (height, width) of the images, for files that do not tell (some of OpenCV's, and scenes of NeRF);
            another size than that of a file that does is refused.
        dtype: of intrinsics and poses, by default torch's default, float32; files are read in float64, which
            ``dtype=torch.float64`` keeps.

    Raises:
        MissingFileError: there is nothing at ``path``.
        FileFormatError: the format is unknown, the file is broken, or has no poses; the message names line or key.
        ArgumentError: ``translation_unit`` is missing, or given for a format that is in metres.

    Examples:
        >>> from sphericalvision.cameras import ring_rig, save_rig
        >>> save_rig(ring_rig(3, radius=0.1), "rig.yaml")
        >>> rig = read_rig("rig.yaml")
        >>> rig.names, round(float(rig.radius), 3)
        (['cam1', 'cam2', 'cam3'], 0.1)
    """
    options = Options(max_angle, dtype, translation_unit, image_size, rig=True)
    return _calibration(path, options).rig(dtype)


def read_cameras(
    path: str | Path,
    *,
    max_angle: float | None = None,
    image_size: tuple[int, int] | None = None,
    dtype: torch.dtype | None = None,
) -> dict[str, Camera]:
    """All cameras of a calibration by name, whether it has poses or not; arguments and errors are ``read_rig``'s.

    Examples:
        >>> from sphericalvision.cameras import ring_rig, save_rig
        >>> save_rig(ring_rig(3), "rig.yaml")
        >>> {name: type(camera).__name__ for name, camera in read_cameras("rig.yaml").items()}["cam2"]
        'FisheyeCamera'
    """
    options = Options(max_angle, dtype, "m", image_size)  # positions are not looked at, so any unit will do
    return _calibration(path, options).cast(dtype)


def read_camera(
    path: str | Path,
    name: str | None = None,
    *,
    max_angle: float | None = None,
    image_size: tuple[int, int] | None = None,
    dtype: torch.dtype | None = None,
) -> Camera:
    """Read a camera from a calibration file that has one, or one of several by name.

    Args:
        path: a file or folder of any format that ``read_rig`` knows, or one of a single camera: OCamCalib's text file,
            COLMAP's ``cameras.txt``, KITTI-360's ``image_02.yaml``, Lafida's ``InteriorOrientationFisheye0.yaml``.
        name: which camera, if there are several: ``cam0``, ``cam1``, ... or its name in the file.
        max_angle: half the field of view in radians, as of ``read_rig``; so are ``image_size``, ``dtype`` and errors.

    Raises:
        ArgumentError: there are several cameras and no ``name``, or none of that name.

    Examples:
        >>> from sphericalvision.cameras import ring_rig, save_rig
        >>> save_rig(ring_rig(3, image_size=(60, 80)), "rig.yaml")
        >>> read_camera("rig.yaml", "cam2").image_size
        (60, 80)
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


def _calibration(path: str | Path, options: Options) -> Calibration:
    """What a file or folder holds."""
    check_type("path", path, (str, Path))
    if options.max_angle is not None and not 0 < float(options.max_angle) < 3.1416:
        raise ArgumentError(
            f"max_angle: expected radians above 0 up to π, got {options.max_angle}; are these degrees?"
        )
    path, *others = _calibration_files(Path(path))
    if others and path.is_dir():
        calibration = joined(path, [_read(part, options) for part in others])
    else:
        calibration = _read(path, options)
        for twin in others:
            if not calibration.is_like(_read(twin, options)):
                raise ArgumentError(f"path: {path} and {twin.name} hold different cameras or poses; name one")
    for name, camera in calibration.cameras.items():
        if re.search("[\0-\x1f\x7f-\x9f\ud800-\udfff]", name):  # names are printed, and in lists of results
            raise FileFormatError(
                f"{path}: expected names without control characters, got {name!r:.80}; rename it"
            )
        if options.image_size is not None and tuple(options.image_size) != camera.image_size:
            raise ArgumentError(
                f"image_size: {path} says itself that images of {name:.80} are {camera.image_size} (height, width), "
                f"got {tuple(options.image_size)}; leave it out, or bring the camera to that size: camera.resized"
            )
    return calibration


def _read(path: Path, options: Options) -> Calibration:
    """What a file holds, by the first format that recognises it."""
    calibration = Calibration(options, path)
    for format in file_formats() if path.suffix.lower() not in STRUCTURED else ():
        if format.recognizes_file and format.read_file and format.recognizes_file(path):
            _check_unit(path, format, options)
            format.read_file(path, calibration)
            calibration.check()
            return calibration
    content = load(path) if looks_structured(path) else None
    entries = content if isinstance(content, list) else [content]
    content = entries[0] if entries else None
    for format in file_formats():
        if not isinstance(content, Keys):
            break
        if format.recognizes_keys and format.read_keys and format.recognizes_keys(content):
            _check_unit(path, format, options)
            if len(entries) > 1:
                raise FileFormatError(
                    f"{path}: holds a list of {len(entries)}: {format.title}; keep one of them"
                )
            content.forget()
            format.read_keys(content, calibration)
            check_understood(content, str(path), format.ignored)
            calibration.check()
            return calibration
    keys = f"; its keys are {', '.join(map(str, content))[:200]}" if isinstance(content, dict) else ""
    raise FileFormatError(f"{path}: {_likely_program(path)}; {known_formats()}{keys}")


_OTHERS = (
    ("Facebook Surround 360's rig", r"\A(?=[\s\S]*\bforward\b)[\s\S]*\borigin\b"),
    ("Kalibr's report, beside which its camchain is", r"(?m)^Camera-system parameters:"),
    ("ROS's ost.txt, beside which its ost.yaml is", r"(?m)^\[(image|narrow_stereo)"),
    ("ZED's camera file", r"(?m)^\[LEFT_CAM_"),
    ("OpenMVG's sfm_data", r"\bsfm_data_version\b"),
    ("AliceVision's or Meshroom's sfm", r"\bfeaturesFolders\b|\bposeId\b"),
    ("a Kalibr camchain whose cameras have neither camera_model nor intrinsics", r"(?m)^cam\d+:"),
    (
        "DSO's camera file",
        r"\A([A-Z]\w+\s+)?([-+.\de]+[ \t]+){4,}[-+.\de]+\s+\d+\s+\d+\s+(crop|full|none|[\d.])",
    ),
)
"""Programs whose files are not read, and what the text of such a file has."""


def _likely_program(path: Path) -> str:
    """What a file is that no format recognises."""
    text = read_text(path)[:100_000].lstrip()
    for program, pattern in _OTHERS:
        if re.search(pattern, text):
            return f"not a calibration that is read, but what looks like {program}"
    return "not a calibration"


_TEXTS = (".json", ".jsonl", ".txt", ".xml", ".yaml", ".yml")


def _check_unit(path: Path, format: FileFormat, options: Options) -> None:
    if format.tells_unit and options.translation_unit not in (None, "m"):
        raise ArgumentError(
            f"translation_unit: {path} is in metres by its format, got {options.translation_unit!r}; only poses.txt "
            "and OpenCV's files need a unit"
        )


def _calibration_files(path: Path) -> list[Path]:
    """The file itself; or the one calibration in a folder, and behind it what must hold the same.

    A folder with one file for each camera comes first itself, with all of them behind it.
    """
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise MissingFileError(
            f"{path}: no such file or folder (a calibration was expected; looked in {path.parent.absolute()})"
        )
    usual = [name for format in file_formats() for name in format.usual_names]
    per_format = [[path / name for name in f.usual_names if (path / name).is_file()] for f in file_formats()]
    matches = [files for files in per_format if files]
    for format in file_formats():
        # A damaged file next to a calibration is no candidate; where there is none it may be a camera of a rig.
        with suppress(FileFormatError) if matches else nullcontext():
            if format.files_of_rig and (parts := format.files_of_rig(path)):
                matches.append([path, *parts])
    if not matches:
        texts = sorted(file.name for file in path.iterdir() if file.suffix in _TEXTS)
        if similar := list(dict.fromkeys([*_similar(path, usual, ("", "*/", "*/*/")), *texts])):
            raise MissingFileError(
                f"{path}: no calibration has its usual name in this folder (poses.txt, of ocam*.txt), but there are "
                f"{', '.join(similar)[:200]}; name the one to read"
            )
        raise MissingFileError(f"{path}: none of {', '.join(usual)} in this folder; {known_formats()}")
    if len(matches) > 1:
        names = [str((files[1] if files[0] == path else files[0]).relative_to(path)) for files in matches]
        raise ArgumentError(
            f"path: {path} holds {' and '.join(names)}, which may differ in scale; name the one to read, or move the "
            "others"
        )
    names = [file.name for file in matches[0] if file != path]
    if copies := _similar(path, names):
        warnings.warn(
            f"{path}: {names[0]} is read, and not {', '.join(copies)[:200]}; name one", stacklevel=5
        )
    return matches[0]


def _similar(folder: Path, names: Sequence[str], parents: Sequence[str] = ("",)) -> list[str]:
    """Files of a folder that are called as one of ``names`` and something more, or as another kind of text."""
    files = {
        str(file.relative_to(folder))
        for parent, name in itertools.product(parents, map(Path, names))
        for file in folder.glob(f"{parent}{name.stem}*")
        if (file.suffix == name.suffix or (file.stem == name.stem and file.suffix in _TEXTS))
        and not (file.parent == folder and file.name in names)
    }
    return sorted(files)
