# SPDX-License-Identifier: Apache-2.0
"""``transforms.json`` of nerfstudio, instant-ngp and the synthetic NeRF scenes: images with poses, one lens or several.

Convention:
    ``transform_matrix`` takes coordinates of an OpenGL camera (x right, y up, z backward) to the world's; the last two
    axes are turned here. Centres of pixels are half a pixel further than here, as in COLMAP. Lengths are in the file's
    own unit, which is metres if the one who made it saw to that.

    As a rig, each frame is a camera, called by its ``file_path`` without the suffix. As cameras, there is one lens for
    all frames, ``cam1``, or one for each if they have intrinsics of their own.

References:
    M. Tancik et al., "Nerfstudio", SIGGRAPH 2023, and its page "Data conventions"; T. Müller et al., "Instant neural
    graphics primitives", TOG 41 (2022).
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Calibration, Options, warn_left_out
from sphericalvision.cameras.calibration.formats import FileFormat
from sphericalvision.cameras.calibration.keys import Keys
from sphericalvision.cameras.calibration.lenses import PANORAMA, Lens, as_rig, lens_called, lens_of, models_of
from sphericalvision.cameras.calibration.parsing import view_name
from sphericalvision.cameras.calibration.poses import OPENGL_FROM_OPENCV
from sphericalvision.cameras.calibration.text_files import write_json
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import ArgumentError, FileFormatError
from sphericalvision.io.images import read_mask

_LENSES = (
    Lens("PINHOLE", "pinhole", "fl_x=fx fl_y=fy cx cy"),
    Lens("SIMPLE_PINHOLE", "pinhole", "fl_x=fx fl_y=fy cx cy"),
    Lens("OPENCV", "brown_conrady", "fl_x=fx fl_y=fy cx cy k1 k2 p1 p2 k3"),
    Lens("OPENCV_FISHEYE", "kannala_brandt", "fl_x=fx fl_y=fy cx cy k1 k2 k3 k4"),
    PANORAMA,
)
_MODELS = tuple(lens.name for lens in _LENSES)
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_OWN = {
    "fl_x",
    "fl_y",
    "camera_angle_x",
    "camera_angle_y",
    "cx",
    "cy",
    "w",
    "h",
    "camera_model",
    "is_fisheye",
}
_OWN |= set(_DISTORTION)
"""Keys by which a frame has a lens of its own."""
_IGNORED = (
    r"aabb\w*|offset|up|from_na|applied_transform|\w*filenames|sharpness\w*|render_aabb|n_extra_learnable_dims|n_frames"
    r"|(orientation|auto_scale_poses)_override|(white|black)_transparent|(integer_depth|depth_unit)_scale\w*|has_mask"
    r"|enable_depth_loading|test_frames|(frames/)?(w|h|camera_angle_[xy]|fl_[xy]|c[xy]|k[1-4]|p[12])|\w*ply\w*_path"
    r"|frames/(sharpness|colmap_im_id|rotation|time|bbox|\w+_path)"
)


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file has frames with a pose or a file, and no cameras apart from them."""
    frames, keys = content.get("frames"), {"transform_matrix", "file_path"}
    is_other = isinstance(frames, list) and all(isinstance(f, dict) and not keys & set(f) for f in frames)
    return "frames" in content and "cameras" not in content and not (frames and is_other)


def read(content: Keys, calibration: Calibration) -> None:
    """A camera for each frame if poses are wanted, else the lenses."""
    frames = _usable(content, calibration.path)
    own = [bool(_OWN & set(frame)) for frame in frames]
    for key in ("scale", "applied_scale"):
        if content.number(key, 1) != 1:
            raise FileFormatError(
                f"{content.at(key)}: expected 1, got {content[key]}; divide the positions by it"
            )
    options, missing = calibration.options, []
    shared = None if all(own) else _camera(content, options)
    is_lens = not options.rig and not any(own)
    views = Calibration(options, calibration.path) if is_lens else calibration
    for frame, has_own in zip(frames, own, strict=True):
        name = view_name(frame.entry("file_path"))
        for key in sorted(_OWN & set(content)) if has_own else ():
            if frame.setdefault(key, content[key]) != content[key]:
                raise FileFormatError(  # instant-ngp takes the frame's, nerfstudio the other
                    f"{frame.at(key)}: expected what the file says for all frames; keep the right one"
                )
        camera = shared if shared and not has_own else _camera(frame, options)
        views.add(name, camera, frame.where, frame.pose("transform_matrix") @ OPENGL_FROM_OPENCV)
        if mask := frame.get("mask_path"):
            file = calibration.path.parent / str(mask)
            if file.is_file():
                views.masks[name] = read_mask(file, camera.image_size)
            else:  # ScanNet++ counts them from a folder that the file does not name
                missing.append(str(mask))
    warn_left_out(calibration.path, "masks that are not there, give them as masks=", missing)
    if is_lens and shared:
        calibration.add("cam1", shared, content.where)


def _usable(content: Keys, path: Path) -> list[Keys]:
    """The frames but for those that ScanNet++ marks as bad."""
    frames = content.several("frames")
    bad = [frame for frame in frames if str(frame.get("is_bad", False)).lower() not in ("false", "0")]
    if len(bad) == len(frames):
        raise FileFormatError(
            f"{path}: all {len(frames)} frames are marked is_bad; expected some that are not"
        )
    warn_left_out(path, "which the file marks as is_bad", [str(frame.get("file_path")) for frame in bad])
    for frame in bad:
        frame.clear()
    return [frame for frame in frames if frame]


def _camera(values: Keys, options: Options) -> Camera:
    """The lens of a frame, with its own keys and those at the top, or of all."""
    has_size = "w" in values or "h" in values
    height, width = size = values.size("w", "h") if has_size else options.given_size(values.where, "w and h")
    model = _model(values)
    if model == PANORAMA.name:
        return PANORAMA.camera([], size, values.where)
    center = [values.number(key, side / 2) - 0.5 for key, side in (("cx", width), ("cy", height))]
    plane = [*_focal_lengths(values, width, height, model == "OPENCV_FISHEYE"), *center]
    coefficients = {key: values.number(key) for key in _DISTORTION if values.get(key) is not None}
    _check_coefficients(coefficients, model, values)
    is_plain = model != "OPENCV_FISHEYE" and not any(coefficients.values())
    lens = lens_called(_LENSES, "PINHOLE" if is_plain else model)
    return lens.camera([*plane, *(coefficients.get(key, 0.0) for key in lens.keys[4:])], size, values.where)


def _model(values: Keys) -> str:
    """The name in ``_LENSES`` that ``camera_model`` and the older ``is_fisheye`` mean, which must agree."""
    name, is_fisheye = values.get("camera_model"), values.get("is_fisheye", False)
    if not name:
        return "OPENCV_FISHEYE" if is_fisheye else "OPENCV"
    model = "OPENCV" if name in ("SIMPLE_RADIAL", "RADIAL") else values.chosen("camera_model", _MODELS)
    if is_fisheye and model != "OPENCV_FISHEYE":
        raise FileFormatError(
            f"{values.at('is_fisheye', 'camera_model')}: tell different models; keep the right one"
        )
    return model


def _check_coefficients(coefficients: dict[str, float], model: str, values: Keys) -> None:
    """Raise for a coefficient that is missing among others, or that is not 0 and the model has not."""
    count = sum(key in coefficients for key in _DISTORTION[:4])
    gaps = [key for key in _DISTORTION[:count] if key not in coefficients]
    for key, other in (("p1", "p2"), ("p2", "p1")):
        if coefficients.get(other) and key not in coefficients:
            gaps.append(key)
    if gaps:
        raise FileFormatError(
            f"{values.where}: the key {gaps[0]!r} is missing, and others of the distortion are there"
        )
    unknown = {"OPENCV_FISHEYE": ("p1", "p2"), "OPENCV": ("k4",)}.get(model, _DISTORTION)
    if wrong := {key: coefficients[key] for key in unknown if coefficients.get(key)}:
        raise FileFormatError(
            f"{values.at(*wrong)}: expected 0 of the camera_model {model}, got {list(wrong.values())}"
        )


def _focal_lengths(values: Keys, width: int, height: int, is_fisheye: bool) -> list[float]:
    """Along u and v, each as a focal length, else from the angle of view, else as the other one.

    Files say both; they have to agree, but for fisheyes, of which programs mean several things by the angle.
    """
    lengths: list[float] = []
    for key, angle, side in (("fl_x", "camera_angle_x", width), ("fl_y", "camera_angle_y", height)):
        half = values.number(angle) / 2 if angle in values else None
        if key in values:
            lengths.append(values.number(key))
        if half is not None and not (key in values and is_fisheye):
            if not 0 < half < math.pi / 2:
                raise FileFormatError(
                    f"{values.at(angle)}: expected radians between 0 and π, got {2 * half:g}"
                )
            lengths.append(side / 2 / math.tan(half))
            if key in values and abs(lengths.pop() - lengths[-1]) > 0.01 * lengths[-1]:
                raise FileFormatError(
                    f"{values.where}: {key} and {angle} tell different lenses; keep the right one"
                )
    if not lengths:
        values.entry("fl_x")
    return [lengths[0], lengths[-1]]


def write_nerfstudio(cameras: Camera | CameraRig, path: str | Path) -> None:
    """Write a camera or a rig of one model; a frame for each camera, whose image is ``images/<name>.png``.

    Fields of view and masks are not part of the format.
    """
    write_json(Path(path), nerfstudio_content(as_rig(cameras)))


def nerfstudio_content(rig: CameraRig) -> dict[str, Any]:
    """What such a file holds."""
    kinds = {}
    frames = []
    poses = rig.world_from_camera.detach().cpu().double() @ OPENGL_FROM_OPENCV
    for (name, camera), pose in zip(rig.cameras.items(), poses, strict=True):
        kinds[name], values = _values(camera)
        frames.append({"file_path": f"images/{name}.png", **values, "transform_matrix": pose.tolist()})
    if len(set(kinds.values())) > 1:
        raise ArgumentError(
            f"rig: nerfstudio has one camera model for all frames, got {kinds}; convert the others: "
            "convert(camera, to=...), or write 'native'"
        )
    return {"camera_model": next(iter(kinds.values())), "frames": frames}


def _values(camera: Camera) -> tuple[str, dict[str, Any]]:
    """Nerfstudio's name of the model, and the keys of its parameters."""
    height, width = camera.image_size
    lens, intrinsics = lens_of(camera, _LENSES, "nerfstudio")
    return lens.name, {
        "w": width,
        "h": height,
        **dict(zip(lens.keys, lens.shifted(intrinsics, 0.5), strict=True)),
    }


FileFormat(
    "nerfstudio",
    "nerfstudio and instant-ngp transforms.json",
    recognizes_keys=recognizes,
    read_keys=read,
    ignored=_IGNORED,
    usual_names=("transforms.json",),
    models=models_of(_LENSES),
    write_camera=write_nerfstudio,
    write_rig=write_nerfstudio,
).register()
