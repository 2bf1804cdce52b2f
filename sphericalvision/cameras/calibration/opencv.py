# SPDX-License-Identifier: Apache-2.0
"""OpenCV's FileStorage (YAML, XML or JSON): one camera, or two with the transform between them.

Convention:
    Names of keys are those of OpenCV's samples, in any spelling: ``camera_matrix``, ``cameraMatrix``, ``K`` or ``M``,
    and ``distortion_coefficients``, ``dist_coeffs`` or ``D``; with 1 and 2, or left and right, for two cameras. ``R``
    and ``T`` take coordinates of the first camera to the second's; the world is the first camera's frame.

    Which model it is: ``xi`` makes it ``cv2.omnidir``, ``fisheye_model: 1`` (or the distortion model equidistant)
    ``cv2.fisheye``. Without either, four coefficients called ``D`` are ``cv2.fisheye``'s, as its documentation calls
    them; any other number or name are those of the pinhole with distortion.

    In ROS's messages the matrix is that of the whole sensor, and the image its part ``roi``, made smaller by
    ``binning_x`` and ``binning_y``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Calibration, Options
from sphericalvision.cameras.calibration.formats import FileFormat
from sphericalvision.cameras.calibration.keys import Keys
from sphericalvision.cameras.calibration.lenses import check_holds, distorted, numbers_of
from sphericalvision.cameras.calibration.opencv_keys import (
    DISTORTION,
    MATRIX,
    MODEL,
    ROTATION,
    SIZE,
    TRANSLATION,
    find,
    rotation,
)
from sphericalvision.cameras.calibration.parsing import camera_matrix, errors_of_file, size_from_width_height
from sphericalvision.cameras.calibration.poses import checked_rigid
from sphericalvision.cameras.calibration.text_files import STRUCTURED, load
from sphericalvision.cameras.registry import model_meant
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import ArgumentError, FileFormatError
from sphericalvision.geometry import invert_transform
from sphericalvision.io.files import atomic_write

_FLAG = ("fisheyemodel", "fisheye")
_PAIRS = {"intrinsics": "extrinsics", "extrinsics": "intrinsics"}
"""File names of OpenCV's stereo sample, each with that of the other half."""
_IGNORED = (
    r"(?i)[rtpqef]_?[12]?|r_?vecs?|t_?vecs?|om|translation|rotation(_?matrix)?|extrinsic(_?parameter)?s|map[xy12]*|flag.*"
    r"|(rectification|projection)(_?matrix)?(_?[12]|_?left|_?right)?|(new|optimal)_?camera_?(matrix|mtx)|valid_?pix_?roi.*"
    r"|(n|nr|nr_?of|num)_?[a-z]+s|frames_?count|used_?im\w+|(rotation|translation)_?vectors|(fix_?)?aspect_?ratio|(image|grid|object)_?points|per_?view_?.*"
)
"""What belongs to rectified images, to views of the board, and to the calibration as a work; R and T of one camera."""
_FOUR = ("kannala_brandt", "unified")
"""Models of ``cv2.fisheye`` and ``cv2.omnidir``, which have so many coefficients."""


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file has a camera matrix, or the rotation and translation between two cameras."""
    if "Camera.type" in content or "Camera.fx" in content:  # ORB-SLAM's, whose LEFT.K is of other images
        return False
    keys = [key for index in ("", "1") if (key := find(content, MATRIX, index))]
    if any(isinstance(content[key], Mapping | list) for key in keys):
        return True
    alone = {str(key).lower() for key in content} == {"r", "t"}
    return bool(
        find(content, ("r",)) and find(content, ("t",)) and (alone or find(content, ("q", "e", "f", "r1")))
    )


def read(content: Keys, calibration: Calibration) -> None:
    """The camera or the two cameras of a parsed file."""
    _add_other_half(content, calibration.path)
    where, options = content.where, calibration.options
    if find(content, MATRIX):
        camera = _as_published(_camera(content, "", where, options), content)
        calibration.add(str(content.get("camera_name") or "cam1"), camera, where)
        return
    lenses = [_camera(content, index, f"{content.where}, camera {index}", options) for index in ("1", "2")]
    poses = _poses(content, options)
    for index, (camera, pose) in enumerate(zip(lenses, poses, strict=True), start=1):
        calibration.add(f"cam{index}", camera, f"{content.where}, camera {index}", pose)


def _poses(content: Keys, options: Options) -> tuple[Tensor | None, Tensor | None]:
    """Of both cameras, if the file has them."""
    where = content.where
    turn, place = find(content, ROTATION, where=where), find(content, TRANSLATION, where=where)
    if turn is None or place is None:
        return None, None
    unit = options.metres(
        where, f"{place}, which is that of the board's squares", content.get("translation_unit")
    )
    second_from_first = torch.eye(4, dtype=torch.float64)
    second_from_first[:3, :3] = rotation(content[turn], content.at(turn))
    second_from_first[:3, 3] = torch.tensor(content.matrix(place, 3), dtype=torch.float64) * unit
    checked_rigid(second_from_first, content.at(turn))
    return torch.eye(4, dtype=torch.float64), invert_transform(second_from_first)


def _add_other_half(content: Keys, path: Path) -> None:
    """OpenCV's stereo sample writes intrinsics and extrinsics into two files side by side."""
    other = path.with_name(f"{_PAIRS.get(path.stem, path.stem)}{path.suffix}")
    if path.stem in _PAIRS and other.is_file():
        more = load(other)
        for key, value in more.items() if isinstance(more, dict) else ():
            if content.setdefault(key, value) != value:
                raise FileFormatError(f"{path} and {other.name} have different values of {key}; keep one")


def _as_published(camera: Camera, content: Keys) -> Camera:
    """The camera of a part of the image, made smaller, where a message of ROS says that it was."""
    if content.get("roi") is not None:
        roi = content.inner("roi")
        left, top, width, height = (
            int(roi.number(key)) for key in ("x_offset", "y_offset", "width", "height")
        )
        roi.get("do_rectify")  # which is for those who rectify
        if any((left, top, width, height)):
            with errors_of_file(roi.where):
                camera = camera.cropped(top, left, height, width)
    across, down = (max(int(content.number(key, 1)), 1) for key in ("binning_x", "binning_y"))
    height, width = camera.image_size
    if height % down or width % across:
        raise FileFormatError(
            f"{content.at('binning_x', 'binning_y')}: {across} and {down} divide no {width} x {height}"
        )
    return camera.resized((height // down, width // across)) if across * down > 1 else camera


def _image_size(content: Keys, index: str, where: str, options: Options) -> tuple[int, int]:
    for suffix in dict.fromkeys((index, "")):
        width = find(content, ("imagewidth", "width", "imgwidth"), suffix, where)
        height = find(content, ("imageheight", "height", "imgheight"), suffix, where)
        size_key = find(content, SIZE, suffix, where)
        sides = (width or f"image_width{suffix}", height or f"image_height{suffix}")
        sizes = {content.size(*sides)} if width or height else set()
        if size_key:
            sizes.add(size_from_width_height(content.matrix(size_key, 2), content.at(size_key)))
        if len(sizes) > 1:
            raise FileFormatError(f"{where}: {size_key} and {width}, {height} differ; keep the right ones")
        if sizes:
            return sizes.pop()
    return options.given_size(where, "image_width and image_height")


def _kind(content: Keys, index: str, where: str, distortion_key: str, count: int) -> str:
    """The model: what all keys say together that tell it, or else the one that has so many coefficients."""
    models = {"xi": "omni"} if find(content, ("xi",), index) else {}
    is_plain = False
    for names in (_FLAG, MODEL[:2], MODEL[2:]):
        key = find(content, names, index, where) or find(content, names, "", where)
        meant = model_meant(content[key]) if key else ""
        if key and names is _FLAG:
            is_plain = meant not in ("1", "10", "true")
            meant = "" if is_plain else "equidistant"
        # Any camera is a pinhole to some
        if key and meant and not (meant == "none" and names[0] != MODEL[0]):
            models[key] = meant
    meanings = set(models.values()) - ({"radtan"} if "xi" in models else set())
    if len(meanings) > 1 or (is_plain and "equidistant" in meanings):
        raise FileFormatError(f"{where}: {', '.join(models)} tell different models; keep the right one")
    if meanings:
        return meanings.pop()
    if count and not is_plain and find(content, ("xi",), {"1": "2", "2": "1"}.get(index, "")):
        raise FileFormatError(
            f"{where}: the key 'xi_{index}' is missing, which the other camera has, or fisheye_model_{index}"
        )
    if count == 4 and not is_plain and distortion_key in ("d", "D", f"d{index}", f"D{index}"):
        if empty := find(content, MODEL[:2], index) or find(content, MODEL[:2]):
            raise FileFormatError(
                f"{where}, {empty}: expected the model of 4 coefficients, plumb_bob or equidistant, got none"
            )
        return "equidistant"
    return {0: "none", 8: "rational_polynomial", 12: "thin_prism", 14: "tilted"}.get(count, "radtan")


def _camera(content: Keys, index: str, where: str, options: Options) -> Camera:
    key = find(content, MATRIX, index, where)
    if key is None:
        raise FileFormatError(
            f"{where}: the camera matrix is missing (camera_matrix{index}, K{index} or M{index}); found "
            f"{', '.join(map(str, content))}"
        )
    size = _image_size(content, index, where, options)
    distortion_key = find(content, DISTORTION, index, where)
    coefficients = content.matrix(distortion_key) if distortion_key else []
    kind = _kind(content, index, where, distortion_key or "", len(coefficients))
    numbers, skew = camera_matrix(content.matrix(key, 9), f"{where}, {key}", kind in ("omni", "equidistant"))
    if kind == "omni":
        xi = find(content, ("xi",), index, where) or "xi"
        numbers += content.matrix(xi, 1)
    return distorted(kind, numbers + coefficients, size, f"{where}, {distortion_key or key}", skew)


def write_opencv(cameras: Camera | CameraRig, path: str | Path) -> None:
    """Write a camera, or a rig of two, as a FileStorage; the suffix (.yaml, .yml, .xml or .json) says of which kind.

    Fields of view and masks are not part of the format, and the frame of the first camera becomes the world.
    """
    path = Path(path)
    if path.suffix.lower() not in STRUCTURED:
        raise ArgumentError(
            f"path: expected the suffix .yaml, .yml, .xml or .json for OpenCV, got {path.name}"
        )
    values: dict[str, Any]
    if isinstance(cameras, CameraRig):
        if len(cameras) != 2:
            raise ArgumentError(
                f"rig: OpenCV's files hold one camera or two, this rig has {len(cameras)}; choose two with "
                "rig.subset([...]), or write 'kalibr', 'basalt' or 'native'"
            )
        first, second = cameras.cameras.values()
        poses = cameras.world_from_camera.detach().cpu().double()
        second_from_first = invert_transform(poses[1]) @ poses[0]
        values = {
            **_values(first, "_1"),
            **_values(second, "_2"),
            "R": second_from_first[:3, :3].numpy(),
            "T": second_from_first[:3, 3:].numpy(),
            "translation_unit": "m",
        }
    else:
        values = _values(cameras, "")
    with atomic_write(path) as unfinished:
        storage = cv2.FileStorage(str(unfinished), cv2.FILE_STORAGE_WRITE)
        for key, value in values.items():
            storage.write(key, value)
        storage.release()


def _values(camera: Camera, suffix: str) -> dict[str, Any]:
    check_holds("opencv", camera)
    tensors = {name: getattr(camera, name) for name in camera.intrinsic_names}
    numbers = {name: numbers_of(tensor) for name, tensor in tensors.items() if tensor is not None}
    (fx, fy), (cx, cy), (skew,) = (
        numbers.get(name, [0.0]) for name in ("focal_length", "principal_point", "skew")
    )
    coefficients = numbers.get("distortion", [0.0] * 4 if "xi" in numbers else [])
    if camera.model in _FOUR:
        if any(coefficients[4:]):
            raise ArgumentError(
                f"camera: OpenCV holds 4 numbers of distortion of {camera.model}, got {coefficients}; write it "
                "as 'native', or convert the camera first: convert(camera, to=...)"
            )
        coefficients = (coefficients + [0.0] * 4)[:4]
    height, width = camera.image_size
    values: dict[str, Any] = {f"image_width{suffix}": width, f"image_height{suffix}": height}
    values[f"fisheye_model{suffix}"] = int(camera.model == "kannala_brandt")
    values[f"camera_matrix{suffix}"] = np.array([[fx, skew, cx], [0, fy, cy], [0, 0, 1]])
    values[f"distortion_coefficients{suffix}"] = np.array(coefficients).reshape(-1, 1)
    if "xi" in numbers:
        values[f"xi{suffix}"] = numbers["xi"][0]
    return values


FileFormat(
    "opencv",
    "OpenCV FileStorage, ROS camera_info",
    recognizes_keys=recognizes,
    read_keys=read,
    usual_names=("extrinsics.yml",),
    tells_unit=False,
    ignored=_IGNORED,
    models=("pinhole", "brown_conrady", "kannala_brandt", "unified"),
    models_with_skew=("kannala_brandt", "unified"),  # whose functions take notice of it
    write_camera=write_opencv,
    write_rig=write_opencv,
).register()
