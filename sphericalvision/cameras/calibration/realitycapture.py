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

from torch import Tensor

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Calibration, Options
from sphericalvision.cameras.calibration.formats import FileFormat
from sphericalvision.cameras.calibration.keys import Keys, check_understood, with_keys
from sphericalvision.cameras.calibration.lenses import Lens
from sphericalvision.cameras.calibration.poses import transform_from_rotation
from sphericalvision.cameras.calibration.text_files import once, parse_xml
from sphericalvision.core import FileFormatError
from sphericalvision.io.files import by_numbers, read_text

_XCR = "{http://www.capturingreality.com/ns/xcr/1.1#}"
_PERSPECTIVE = Lens("perspective", "pinhole", "FocalLength35mm=fx AspectRatio=fy cx cy")
_BROWN = Lens("brown3t2", "brown_conrady", "FocalLength35mm=fx AspectRatio=fy cx cy k1 k2 k3 t1=p2 t2=p1")
_IGNORED = r"\w*(Version|Prior|Group|Coordinates|In(Texturing|Meshing|Coloring)|Id|Enabled)|(lat|long|alt)itude|version"
_MODELS = ("perspective", "brown3", "brown4", "brown3t2", "brown4t2")


def recognizes(path: Path) -> bool:
    """Whether a file is called ``*.xmp`` and speaks of Capturing Reality."""
    return path.suffix.lower() == ".xmp" and _XCR[1:-1] in read_text(path)


def files_of_rig(folder: Path) -> list[Path]:
    """The XMPs of the folder, one for each image."""
    return [path for path in sorted(folder.glob("*.xmp"), key=by_numbers) if recognizes(path)]


def read(path: Path, calibration: Calibration) -> None:
    """The camera of a file, called like it, and its pose if the file has one."""
    root = parse_xml(read_text(path), path)
    pairs = []
    for element in root.iter():  # an attribute or an element, from version to version
        if element.tag.startswith(_XCR):
            pairs.append((element.tag, element.text or ""))
        pairs += [(key, text) for key, text in element.attrib.items() if _XCR in key]
    words = once(((key.removeprefix(_XCR), text.split()) for key, text in pairs), path)
    values = with_keys(words, str(path))
    camera = _camera(values, path, calibration.options)
    pose = _pose(values) if "Rotation" in values or "Position" in values else None
    check_understood(values, str(path), _IGNORED)
    calibration.add(path.stem, camera, str(path), pose)


def _camera(values: Keys, path: Path, options: Options) -> Camera:
    kind = " ".join(values.get("DistortionModel", ["perspective"]))
    has_none = kind not in _MODELS[1:] and "DistortionCoeficients" not in values
    coefficients = [] if has_none else values.numbers("DistortionCoeficients")
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
    if skew := values.number("Skew", 0.0):
        raise FileFormatError(f"{path}, Skew: expected 0, got {skew:g}; align without it")
    height, width = size = options.given_size(str(path))
    side = max(height, width)
    focal = values.number("FocalLength35mm") * side / 36
    fallback = None if "PrincipalPointU" in values or "PrincipalPointV" in values else 0.0  # both or none
    u, v = (values.number(f"PrincipalPoint{axis}", fallback) * side - 0.5 for axis in "UV")
    plane = [focal, focal * values.number("AspectRatio", 1.0), width / 2 + u, height / 2 + v]
    if not any(coefficients):
        return _PERSPECTIVE.camera(plane, size, str(path))
    return _BROWN.camera([*plane, k1, k2, k3, t1, t2], size, str(path))


def _pose(values: Keys) -> Tensor:
    turn, place = values.numbers("Rotation", 9), values.numbers("Position", 3)
    # Its transpose takes the camera's axes to the world
    columns = [value for column in range(3) for value in turn[column::3]]
    return transform_from_rotation(columns, place, values.at("Rotation"))


FileFormat(
    "realitycapture",
    "RealityCapture xmp",
    recognizes_file=recognizes,
    read_file=read,
    files_of_rig=files_of_rig,
).register()
