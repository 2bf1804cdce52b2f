# SPDX-License-Identifier: Apache-2.0
"""Captures as commands name them: calibration, cameras and masks by keys, and what is said of them."""

from __future__ import annotations

import glob
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sphericalvision.cameras import Camera, CameraRig, EquirectangularCamera, read_cameras, read_trajectory
from sphericalvision.capture import find_own_body
from sphericalvision.capture.preparation.own_body import MOST
from sphericalvision.capture.preparation.preparation import AUTO
from sphericalvision.capture.sources.frames import Selection, Source
from sphericalvision.capture.sources.moving import NAME, Moving
from sphericalvision.capture.sources.opening import (
    IMAGE_SUFFIXES,
    open_source,
    rig_for_images,
    rig_with_masks,
    spread_evenly,
)
from sphericalvision.core import ArgumentError
from sphericalvision.io.images import read_image_size, read_mask, write_mask
from sphericalvision.recipes.app.rigs import keys_named, radians, rig_from_file, whole
from sphericalvision.sphere.intake import as_photographs

__all__ = ["masked_by_itself", "open_capture", "open_moving", "with_own_body_masked"]

PANORAMA = "equirectangular"
"""In place of a calibration file: images are whole panoramas of any size."""


def open_capture(keys: Mapping[str, Any]) -> Source:
    """The frames of a capture, with its rig, in the size of its images and with its masks on.

    Args:
        keys: of a command: ``images``, ``frames``, ``calibration`` (of a pattern with fields the folder above them) and
            those of ``rig_from_file``, ``cameras``, ``masks`` (``"auto"`` is none yet).
    """
    calibration = keys["calibration"]
    if "{" in calibration:
        calibration = str(Path(calibration.partition("{")[0] + "_").parent)
    said = keys["translation_unit"], keys["max_angle_deg"]
    try:
        rig = rig_from_file(calibration, *said, keys["image_size"])
    except ArgumentError as error:
        size = None if keys["image_size"] else size_of_images(keys["images"])
        if size is None or not str(error).startswith("image_size: "):
            raise
        rig = rig_from_file(calibration, *said, size)
    if keys["cameras"] is not None:
        rig = rig.subset(list(keys["cameras"]))
    files: list[Path] = []
    if keys["masks"] not in (None, AUTO):
        rig, files = rig_with_masks(rig, keys["masks"])
    source = open_source(keys["images"], rig, keys["frames"], files)
    sizes = source.sizes()
    source.rig = rig_for_images(rig, sizes)
    for name in rig.names:
        if source.rig.cameras[name].image_size != rig.cameras[name].image_size:
            (height, width), (h, w) = sizes[name], rig.cameras[name].image_size
            print(
                f"Warning: images of {name} have {width} x {height} pixels (width x height), the calibration is for "
                f"{w} x {h}. They are taken as the whole image resized; if they are a part of it, depth will be wrong: "
                "crop the calibration, or capture at its size."
            )
            break
    return source


def size_of_images(pattern: str) -> tuple[int, int] | None:
    """Height and width of the images of a pattern; None where these are not all the same."""
    files = glob.glob(re.sub(r"\{.*?\}", "*", pattern))
    sizes = {read_image_size(file) for file in files if Path(file).suffix.lower() in IMAGE_SUFFIXES}
    return sizes.pop() if len(sizes) == 1 else None


def open_moving(keys: Mapping[str, Any]) -> Moving:
    """The images of one camera or of a rig, and their poses.

    Args:
        keys: of ``sphericalvision-predict`` with ``poses``; ``calibration`` may be ``PANORAMA``.

    Raises:
        ArgumentError: one camera, and a key that is for rigs.
    """
    trajectory = read_trajectory(keys["poses"]).turned(keys["up"])
    cameras: dict[str, Camera] = {NAME: EquirectangularCamera((512, 1024))}
    if keys["calibration"] != PANORAMA:
        angle, given = radians(keys["max_angle_deg"]), whole(keys["image_size"])
        with keys_named(path="calibration", max_angle="max_angle_deg"):
            cameras = read_cameras(keys["calibration"], max_angle=angle, image_size=given)
    source = open_capture(keys) if len(cameras) > 1 else _open_single(next(iter(cameras.values())), keys)
    with keys_named(images="poses"):
        return Moving(source, trajectory, keys["window"], keys["spacing"] or 0.0)


def _open_single(camera: Camera, keys: Mapping[str, Any]) -> Source:
    """The images of one camera, with a mask on."""
    for key in ("cameras", "translation_unit"):
        if keys[key] is not None:
            raise ArgumentError(f"{key}: with poses there is one camera, in metres; leave {key} out")
    if keys["masks"] == AUTO:
        raise ArgumentError("masks: auto is for rigs; of one camera give an image, white where usable")
    files = [] if keys["masks"] is None else [Path(keys["masks"])]
    single = CameraRig({NAME: camera}, torch.eye(4)[None])
    source = open_source(keys["images"], single, keys["frames"], files)
    single = rig_for_images(single, source.sizes())
    size = single.cameras[NAME].image_size
    masks = [read_mask(file, size, "the mask") for file in files]
    source.rig = single.replaced(masks=dict(zip([NAME], masks, strict=False)))
    return source


def masked_by_itself(source: Source, folder: Path) -> CameraRig:
    """The rig of a source with masks of its own body, which are written to ``masks/{camera}.png`` of a folder.

    Args:
        source: a recording; up to fifty frames of all of it are read, whichever are to be predicted.
        folder: of the results.

    Raises:
        ArgumentError: live cameras, which cannot be read twice.
    """
    if source.live:
        raise ArgumentError(
            "masks: auto reads the frames before the first is predicted, which live cameras do not allow; record "
            "some, predict with masks=auto, and give its masks: masks='.../masks/{camera}.png'"
        )
    names = source.names(Selection())
    wanted = None if names is None else set(spread_evenly(names, MOST))
    frames = source.frames(Selection(), lambda name: wanted is None or name in wanted)
    images = (as_photographs(f.images, source.rig) for f in frames if f.images is not None)
    rig = with_own_body_masked(source.rig, images)
    for name, mask in rig.masks.items():
        write_mask(folder / "masks" / f"{name}.png", mask)
    return rig


def with_own_body_masked(rig: CameraRig, frames: Iterable[Mapping[str, Tensor]]) -> CameraRig:
    """The rig with masks of its own body, of which a line for each camera is printed."""
    found = find_own_body(rig, frames)
    for line in found.described():
        print(line)
    return rig.replaced(masks=found.masks)
