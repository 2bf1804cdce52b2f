# SPDX-License-Identifier: Apache-2.0
"""Write a data set in the layout of the omnidirectional stereo sets, for this package's reader and other "
"people's."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import yaml

from sphericalvision.cameras import CameraRig, OCamCamera
from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.data.ground_truth import write_ground_truth
from sphericalvision.data.image_io import whole_file, write_image
from sphericalvision.data.ocam_fit import ocam_from_camera
from sphericalvision.data.omnistereo_files import RELEASES, Release, check_scale, index_frames

__all__ = ["write_omnistereo"]


def write_omnistereo(
    root: str | Path,
    frames: Iterable[Mapping[str, Any]],
    rig: CameraRig,
    release: str = "png",
    min_depth: float = 0.55,
) -> list[str]:
    """Write frames and calibration so that ``OmniStereoDataset(root, split="all")`` reads them back.

    Lengths are written as they are: a scene of one's own has one scale, and both releases of it the same.
    Images lose half a grey level, the PNG release's inverse depth half of 1 / (65500 * min_depth) 1/m, the
    TIFF release's nothing. Cameras that are no ``OCamCamera`` are written as OCam fits (within 0.1 px).
    Masks are part of the TIFF release only. Files of the same name are replaced.

    Args:
        root: folder, made if need be; it must not hold the other release.
        frames: samples as ``OmniStereoDataset`` gives them, consumed one by one: ``images`` (camera name ->
            float ``(3, h, w)`` in [0, 1]), ``inverse_depth`` ``(H, W)`` in 1/m, optionally ``valid``, and
            ``frame``, a number or its digits.
        rig: its cameras become cam1, cam2, ... in their order.
        release: "png" (ocam*.txt, poses.txt in cm, 16-bit ground truth) or "tiff" (config.yaml, float
            ground truth).
        min_depth: metres, at least the rig's radius; scales the PNG encoding and stands in config.yaml.

    Returns:
        Names of the frames written, five digits each.

    Raises:
        ArgumentError: ``root`` holds the other release or frames of another rig, or a frame has other cameras than the
            rig, or is no number.
        FileFormatError: ``min_depth`` and the rig are a mixture of the published scales, which no reader
            may accept.
    """
    check_choice("release", release, tuple(RELEASES))
    root, layout = Path(root), RELEASES[release]
    for other in RELEASES.values():
        if other is not layout and (
            (root / other.calibration).exists() or (root / other.ground_truth_folder).exists()
        ):
            raise ArgumentError(
                f"root: {root} holds a {other.name.upper()} release; write into another folder"
            )
    check_scale(root, layout, min_depth, float(rig.radius))
    ocams = [ocam_from_camera(camera) for camera in rig.cameras.values()]
    _refuse_other_calibration(root, layout, _calibration(root, layout, rig, ocams, min_depth))
    _write_masks(root, layout, rig)
    _write_calibration(root, _calibration(root, layout, rig, ocams, min_depth))
    written = [_write_frame(root, layout, rig, sample, min_depth) for sample in frames]
    _write_calibration(root, _calibration(root, layout, rig, ocams, min_depth))  # now it knows the last frame
    return [f"{frame:05d}" for frame in written]


def _write_frame(
    root: Path, layout: Release, rig: CameraRig, sample: Mapping[str, Any], min_depth: float
) -> int:
    try:
        frame = int(sample["frame"])
    except ValueError:
        raise ArgumentError(f"frame: expected a number or its digits, got {sample['frame']!r}") from None
    images = sample["images"]
    if set(images) != set(rig.names):
        raise ArgumentError(f"frame {frame}: expected images of {list(rig.names)}, got {list(images)}")
    for number, name in enumerate(rig.names, start=1):
        size = tuple(images[name].shape[-2:])
        if size != tuple(rig.cameras[name].image_size):
            raise ArgumentError(
                f"frame {frame}: image of {name}: expected (h, w) = {tuple(rig.cameras[name].image_size)}, "
                f"got {size}"
            )
        write_image(root / f"cam{number}" / f"{frame:05d}.png", images[name])
    truth = root / layout.ground_truth_folder / f"{frame:05d}{layout.suffix}"
    write_ground_truth(truth, sample["inverse_depth"], min_depth, sample.get("valid"))
    return frame


def _calibration(
    root: Path, layout: Release, rig: CameraRig, ocams: list[OCamCamera], min_depth: float
) -> dict[str, str]:
    """Names and contents of the calibration files; config.yaml names the range of the frames in ``root``."""
    poses = [_pose_numbers(pose) for pose in rig.world_from_camera.detach().to("cpu", torch.float64).numpy()]
    if layout.name == "png":
        in_cm = [[*pose[:3], *(100 * value for value in pose[3:])] for pose in poses]
        files = {f"ocam{number}.txt": _ocam_text(ocam) for number, ocam in enumerate(ocams, start=1)}
        return {**files, layout.calibration: "".join(_line(pose) for pose in in_cm)}
    dataset: dict[str, Any] = {"img_fmt": "cam%d/%05d.png"}
    frames = _frames_in(root, layout)
    if frames:
        dataset.update(start=min(frames), step=1, end=max(frames))
    config = {
        "config": {"omnimvs_sweep_min_depth": float(min_depth)},
        "dataset": dataset,
        "cameras": [
            _ocam_entry(number, *pair) for number, pair in enumerate(zip(ocams, poses, strict=True), start=1)
        ],
    }
    return {layout.calibration: yaml.safe_dump(config, sort_keys=False, default_flow_style=None)}


def _write_calibration(root: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        with whole_file(root / name) as temporary:
            temporary.write_text(text)


def _write_masks(root: Path, layout: Release, rig: CameraRig) -> None:
    """In these sets a mask marks what must not be used; only config.yaml can refer to one."""
    for number, name in enumerate(rig.names, start=1):
        if layout.name == "tiff" and name in rig.masks:
            write_image(root / f"mask{number}.png", (~rig.masks[name]).to(torch.float32)[None])


def _refuse_other_calibration(root: Path, layout: Release, files: dict[str, str]) -> None:
    """More frames may be added to a set, but not frames of another rig."""
    if not _frames_in(root, layout):
        return
    for name, text in files.items():
        path = root / name
        if path.is_file() and _without_range(path.read_text()) != _without_range(text):
            raise ArgumentError(
                f"root: {root} holds frames whose {name} differs from the rig or min_depth given; to add frames use "
                f"the same, else write into another folder"
            )


def _frames_in(root: Path, layout: Release) -> list[int]:
    folder = root / layout.ground_truth_folder
    return list(index_frames(folder, "ground truth", (layout.suffix,))) if folder.is_dir() else []


def _without_range(text: str) -> str:
    return "\n".join(line for line in text.splitlines() if not line.startswith("dataset: "))


def _pose_numbers(world_from_camera: np.ndarray) -> list[float]:
    """Axis-angle in radians and translation in metres, camera to rig."""
    rotation_vector, _ = cv2.Rodrigues(world_from_camera[:3, :3])
    return [*map(float, rotation_vector.ravel()), *map(float, world_from_camera[:3, 3])]


def _ocam_numbers(ocam: OCamCamera) -> dict[str, list[float]]:
    """Coefficients as the files have them; the centre turns from (u, v) to (row, column)."""
    assert ocam.inverse_polynomial is not None
    u, v = ocam.principal_point.tolist()
    return {
        "poly": ocam.polynomial.tolist(),
        "inv_poly": ocam.inverse_polynomial.tolist(),
        "center": [v, u],
        "affine": ocam.affine.tolist(),
    }


def _ocam_text(ocam: OCamCamera) -> str:
    numbers = _ocam_numbers(ocam)
    return (
        "#polynomial coefficients for the DIRECT mapping function (ocam_model.ss in MATLAB)\n\n"
        f"{len(numbers['poly'])} {_line(numbers['poly'])}\n"
        "#polynomial coefficients for the inverse mapping function, ascending in the angle from the image "
        f"plane\n\n{len(numbers['inv_poly'])} {_line(numbers['inv_poly'])}\n"
        f'#center: "row" and "column", starting from 0 (C convention)\n\n{_line(numbers["center"])}\n'
        f'#affine parameters "c", "d", "e"\n\n{_line(numbers["affine"])}\n'
        f'#image size: "height" and "width"\n\n{_line(list(ocam.image_size))}\n'
    )


def _ocam_entry(number: int, ocam: OCamCamera, pose: list[float]) -> dict[str, Any]:
    numbers = _ocam_numbers(ocam)
    return {
        "cam_id": number,
        "img_dir": f"cam{number}",
        "model": "ocam",
        "poly": [len(numbers["poly"]), *numbers["poly"]],
        "inv_poly": [len(numbers["inv_poly"]), *numbers["inv_poly"]],
        "center": numbers["center"],
        "affine": numbers["affine"],
        "image_size": list(ocam.image_size),
        "invalid_mask": f"mask{number}.png",
        "pose": pose,
        "max_fov": math.degrees(2 * float(ocam.max_angle)),
    }


def _line(values: list[float] | list[int]) -> str:
    return " ".join(f"{value:.17g}" for value in values) + "\n"
