# SPDX-License-Identifier: Apache-2.0
"""RealityCapture's (RealityScan's) XMP beside an image: its lens and its pose.

Convention:
    With s the longer side of the image, the focal length is ``FocalLength35mm`` · s / 36 and the principal point the
    middle plus (``PrincipalPointU``, ``PrincipalPointV``) · s, where the first pixel's centre is (0.5, 0.5): half a
    pixel is taken off. ``DistortionCoeficients`` (so spelled) are k1 k2 k3 k4 t1 t2 of a Brown model; t1 and t2 are
    OpenCV's p2 and p1.

    ``Rotation``, row by row, takes the world's axes to the camera's (x right, y down, z forward); ``Position`` is the
    camera's, in the world. The file does not tell the size of the image.

References:
    Capturing Reality, "RealityCapture XMP Camera Math", 2022.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import torch
from torch import Tensor

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Contents, Options
from sphericalvision.cameras.calibration.files import read_text
from sphericalvision.cameras.calibration.formats import FileFormat, register_format
from sphericalvision.cameras.calibration.parsing import errors_of_file, focal_lengths, numbers
from sphericalvision.cameras.calibration.poses import transform_from_rows
from sphericalvision.cameras.calibration.visible_part import bounded
from sphericalvision.cameras.models.brown_conrady import BrownConradyCamera
from sphericalvision.cameras.models.pinhole import PinholeCamera
from sphericalvision.core import ArgumentError, FileFormatError

__all__ = ["contents", "files_of_rig", "recognizes"]

_XCR = "{http://www.capturingreality.com/ns/xcr/1.1#}"
_MODELS = ("perspective", "brown3", "brown4", "brown3t2", "brown4t2")


def recognizes(path: Path) -> bool:
    """Whether a file is called ``*.xmp`` and speaks of Capturing Reality."""
    return path.suffix.lower() == ".xmp" and _XCR[1:-1] in read_text(path)


def files_of_rig(folder: Path) -> list[Path]:
    """The XMPs of the folder, one for each image."""
    return [path for path in sorted(folder.glob("*.xmp")) if recognizes(path)]


def contents(path: Path, options: Options) -> Contents:
    """The camera of a file, called like it, and its pose if the file has one.

    Raises:
        FileFormatError: an attribute is missing, or its value makes no sense; the message names it.
        ArgumentError: the size of the image is not given.
    """
    text = read_text(path)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise FileFormatError(f"{path}: an XMP has no document type or entities, this file has")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise FileFormatError(f"{path}: not valid XML ({error}); is it truncated?") from None
    values: dict[str, str] = {}
    for element in root.iter():  # an attribute or an element, from version to version
        if element.tag.startswith(_XCR):
            values[element.tag.removeprefix(_XCR)] = element.text or ""
        values |= {key.removeprefix(_XCR): text for key, text in element.attrib.items() if _XCR in key}
    camera = bounded(_camera(values, path, options), options.max_angle, str(path))
    pose = _pose(values, path) if "Rotation" in values and "Position" in values else None
    return Contents({path.stem: camera}, pose)


def _camera(values: dict[str, str], path: Path, options: Options) -> Camera:
    def get(key: str, default: str | None = None, count: int | None = 1) -> list[float]:
        found = values.get(key, default)
        if found is None:
            raise FileFormatError(f"{path}: {key} is missing; found {', '.join(values) or 'none'}")
        return numbers(found.split(), f"{path}, {key}", count)

    kind = values.get("DistortionModel", "perspective")
    coefficients = get("DistortionCoeficients", "0 0 0 0 0 0", None)
    if len(coefficients) > 6:
        raise FileFormatError(
            f"{path}, DistortionCoeficients: expected 6 numbers at most, got {len(coefficients)}"
        )
    k1, k2, k3, k4, t1, t2 = coefficients + [0.0] * (6 - len(coefficients))
    if (kind not in _MODELS and any(coefficients)) or k4:
        raise FileFormatError(
            f"{path}, DistortionModel: expected {' or '.join(_MODELS)} without a fourth radial coefficient, got "
            f"{kind!r:.80} with {coefficients}; choose brown3 or brown3t2 as the model before exporting"
        )
    if get("Skew", "0")[0]:
        raise FileFormatError(f"{path}, Skew: expected 0, got {values['Skew']!r:.80}; align without it")
    if options.image_size is None:
        raise ArgumentError(f"image_size: {path} does not tell it; pass image_size=(height, width)")
    height, width = options.image_size
    side = max(height, width)
    focal = get("FocalLength35mm")[0] * side / 36
    aspect = get("AspectRatio", "1")[0]
    center = [
        width / 2 + get("PrincipalPointU", "0")[0] * side - 0.5,
        height / 2 + get("PrincipalPointV", "0")[0] * side - 0.5,
    ]
    where = f"{path}, FocalLength35mm and AspectRatio"
    focal_length = torch.tensor(focal_lengths([focal, focal * aspect], where), dtype=torch.float64)
    with errors_of_file(str(path)):
        if not any(coefficients):
            return PinholeCamera(focal_length, center, options.image_size)
        return BrownConradyCamera(focal_length, center, [k1, k2, t2, t1, k3], options.image_size)


def _pose(values: dict[str, str], path: Path) -> Tensor:
    rows = torch.tensor(numbers(values["Rotation"].split(), f"{path}, Rotation", 9), dtype=torch.float64)
    position = numbers(values["Position"].split(), f"{path}, Position", 3)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rows.reshape(3, 3).T
    pose[:3, 3] = torch.tensor(position, dtype=torch.float64)
    return transform_from_rows(pose.flatten().tolist(), f"{path}, Rotation")[None]


register_format(
    FileFormat(
        "realitycapture",
        "RealityCapture xmp",
        recognizes_file=recognizes,
        contents_of_file=contents,
        files_of_rig=files_of_rig,
    )
)
