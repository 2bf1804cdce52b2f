# SPDX-License-Identifier: Apache-2.0
"""OCamCalib text files, alone or with ``poses.txt`` as the older release of the stereo sets has them.

A file has ``#`` comments, blank lines and five lines of data: direct polynomial and inverse polynomial, each preceded
by its number of coefficients, centre as **row, column** from 0, affine c d e, and height width.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

import torch

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Calibration
from sphericalvision.cameras.calibration.formats import FileFormat
from sphericalvision.cameras.calibration.lenses import check_holds, numbers_of
from sphericalvision.cameras.calibration.parsing import errors_of_file, numbers, size_from_width_height
from sphericalvision.cameras.calibration.poses import transform_from_rotation_vector
from sphericalvision.cameras.calibration.text_files import data_lines, looks_structured
from sphericalvision.cameras.models.ocam import OCamCamera
from sphericalvision.core import ArgumentError, FileFormatError, MissingFileError, check_file
from sphericalvision.io.files import by_numbers, read_text, write_bytes

STEREO_SETS_MAX_ANGLE = math.radians(110)
"""Half the field of view of the omnidirectional stereo sets' lenses, which their text files do not tell."""

_POSES = "poses.txt"
_LINES = (
    "direct polynomial (count, then coefficients)",
    "inverse polynomial (count, then coefficients)",
    "centre (row column)",
    "affine (c d e)",
    "image size (height width)",
)


def recognizes(path: Path) -> bool:
    """Whether a file is called ``poses.txt``, or its first line of data begins with a count."""
    if path.name == _POSES:
        return True
    if looks_structured(path):
        return False
    lines = data_lines(path)
    return not lines or bool(re.match(r"\d{1,3}(\.0*)?( [-+.\dni]|$)", " ".join(lines[0][1])))


def read(path: Path, calibration: Calibration) -> None:
    """The camera of a text file, or those of the folder in which ``poses.txt`` lies."""
    if path.name == _POSES:
        _read_folder(path.parent, calibration)
        return
    unit = calibration.options.translation_unit
    if unit not in (None, "m"):
        raise ArgumentError(f"translation_unit: {path} is one camera without a translation, got {unit!r}")
    calibration.add(path.stem, _ocam(path), str(path))


def counted(values: list[float], where: str) -> list[float]:
    """Coefficients from ``[count, *coefficients]``."""
    if len(values) < 2:
        raise FileFormatError(
            f"{where}: expected the number of coefficients and at least one coefficient, got {values}"
        )
    count, coefficients = values[0], values[1:]
    if count != len(coefficients):
        raise FileFormatError(
            f"{where}: announces {count:g} coefficients but holds {len(coefficients)}; is the file truncated?"
        )
    return coefficients


def make_ocam(
    direct: Sequence[float],
    inverse: Sequence[float] | None,
    center: Sequence[float],
    affine: Sequence[float],
    size: tuple[int, int],
    where: str,
    *,
    of_columns: bool = False,
) -> OCamCamera:
    """A camera of polynomials, a centre as (u, v) and an affine part c d e, checked by ``check_inverse``.

    The affine part is OCamCalib's; or with ``of_columns`` that of a program in which it acts on (x, y), not on (row,
    column). With radii in units c times smaller it is an ``OCamCamera``, which has 1 where that program has c.
    """
    if of_columns:
        c, d, e = affine
        if not 1e-3 < c < 1e3:  # it is a ratio of two sides of a pixel
            raise FileFormatError(f"{where}: expected the first number of the affine part about 1, got {c:g}")
        direct = [value * c ** (1 - power) for power, value in enumerate(direct)]
        inverse = None if inverse is None else [value * c for value in inverse]
        affine = [1 / c, e / c, d / c]
    with errors_of_file(where):
        camera = OCamCamera(
            torch.tensor(direct, dtype=torch.float64), inverse, center, affine, size, max_angle=math.pi
        )
    return check_inverse(camera, where)


def check_inverse(camera: OCamCamera, where: str) -> OCamCamera:
    """``camera`` if its polynomials are of one lens: points of half of the middle row come back to within 5 % of it.

    Those of published files come back to within 0.3 %.
    """
    half = camera.image_size[1] / 4
    u = camera.principal_point[0] + torch.linspace(-half, half, 33, dtype=torch.float64)
    pixels = torch.stack((u, camera.principal_point[1].expand_as(u)), -1)
    directions, valid = camera.unproject(pixels)
    back = camera.project(
        directions
    ).pixels  # also where the inverse polynomial is below 0, which is not seen
    off = float(torch.where(valid, (back - pixels).norm(dim=-1), 0.0).max())
    if off > 0.05 * camera.image_size[1]:
        raise FileFormatError(
            f"{where}: the direct and the inverse polynomial contradict each other by {off:.0f} pixels; are they of "
            "one lens?"
        )
    return camera


def _ocam(path: Path) -> OCamCamera:
    lines = data_lines(path)
    if len(lines) < len(_LINES):
        last = lines[-1][0] if lines else 0
        raise FileFormatError(
            f"{path}: truncated after line {last}: the {_LINES[len(lines)]} is missing "
            f"(an OCamCalib file has {len(_LINES)} lines of data, this one {len(lines)})"
        )
    if len(lines) > len(_LINES):
        raise FileFormatError(
            f"{path}, line {lines[5][0]}: expected {len(_LINES)} lines of data, this is one more"
        )
    counts = (None, None, 2, 3, 2)
    direct, inverse, center, affine, size = (
        numbers(words, f"{path}, line {number}, {name}", count)
        for (number, words), name, count in zip(lines, _LINES, counts, strict=False)
    )
    direct, inverse = (
        counted(values, f"{path}, line {number}, {name}")
        for values, (number, _), name in zip((direct, inverse), lines, _LINES, strict=False)
    )
    image_size = size_from_width_height(size[::-1], f"{path}, image size")
    return make_ocam(direct, inverse, center[::-1], affine, image_size, str(path))


def _read_folder(folder: Path, calibration: Calibration) -> None:
    poses_path = check_file(folder / _POSES, "the poses of the cameras")
    files = sorted(folder.glob("ocam*.txt"), key=by_numbers)
    if not files:
        raise MissingFileError(
            f"{folder}: no ocam1.txt, ocam2.txt, ... beside poses.txt (one for each camera expected)"
        )
    comment = re.search(r"^# translation_unit: (\S+)", read_text(poses_path), re.MULTILINE)
    unit = calibration.options.metres(
        str(poses_path),
        "its positions ('cm' in OmniThings, OmniHouse and the urban sets)",
        comment and comment[1],
    )
    lines = data_lines(poses_path)
    if len(lines) != len(files):
        raise FileFormatError(
            f"{poses_path}: holds {len(lines)} poses, but the folder has {len(files)} cameras "
            f"({', '.join(file.name for file in files)}); one line for each camera expected"
        )
    for place, (file, (number, words)) in enumerate(zip(files, lines, strict=True), start=1):
        name = f"cam{file.stem.removeprefix('ocam').lstrip('_') or place}"
        where = f"{poses_path}, line {number}"
        row = numbers(words, where, 6)
        pose = transform_from_rotation_vector(row[:3], [unit * value for value in row[3:]], where)
        calibration.add(name, _ocam(file), str(file), pose, STEREO_SETS_MAX_ANGLE)


def ocam_numbers(camera: Camera, format: str) -> dict[str, list[float]]:
    """The numbers of a camera as files hold them: counts in front of polynomials, the centre as (row, column).

    By OmniMVS's keys, in the order of an OCamCalib file.
    """
    check_holds(format, camera)
    assert isinstance(camera, OCamCamera)
    if camera.inverse_polynomial is None:
        raise ArgumentError(
            f"camera: the format {format!r} holds an inverse polynomial and this camera inverts exactly; fit one with "
            "fit_inverse_polynomial(camera), or write 'native'"
        )
    direct, inverse = numbers_of(camera.polynomial), numbers_of(camera.inverse_polynomial)
    column, row = numbers_of(camera.principal_point)
    return {
        "poly": [len(direct), *direct],
        "inv_poly": [len(inverse), *inverse],
        "center": [row, column],
        "affine": numbers_of(camera.affine),
        "image_size": list(camera.image_size),
    }


def write_ocam_text(camera: Camera, path: str | Path) -> None:
    """Write an ``OCamCamera`` as an OCamCalib text file; the field of view is not part of the format."""
    values = ocam_numbers(camera, "ocamcalib")
    lines = []
    for title, row in zip(_LINES, values.values(), strict=True):
        lines += [f"# {title}", "", " ".join(map(repr, row)), ""]
    write_bytes(path, "\n".join(lines).encode())


FileFormat(
    "ocamcalib",
    "OCamCalib text, alone or several with poses.txt",
    recognizes_file=recognizes,
    read_file=read,
    usual_names=(_POSES,),
    tells_unit=False,
    models=("ocam",),
    write_camera=write_ocam_text,
).register()
