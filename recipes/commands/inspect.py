# SPDX-License-Identifier: Apache-2.0
"""Numbers and pictures of a rig: ``sphericalvision-inspect calibration=capture/config.yaml``."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import torch
from annotated_types import MinLen
from pydantic.dataclasses import dataclass
from torch import Tensor

from sphericalvision.cameras import CameraRig, coverage, field_of_view, overlap
from sphericalvision.cameras.field_of_view import focal_length_on_axis
from sphericalvision.capture.sources.frames import Selection
from sphericalvision.capture.sources.opening import open_source, rig_with_masks
from sphericalvision.core import ArgumentError
from sphericalvision.icosphere import Icosphere
from sphericalvision.io.files import part_of_name
from sphericalvision.io.images import write_image
from sphericalvision.recipes.app.captures import cameras_and_labels, cut_to_visible, print_labels
from sphericalvision.recipes.app.cli import console, print_table
from sphericalvision.recipes.app.kinds import STRICT, Distance, Names, Number, OnlyWith, Text
from sphericalvision.recipes.app.rigs import Calibration, keys_named
from sphericalvision.sphere.intake import as_photographs
from sphericalvision.viz import angle_map, coverage_panorama, rig_picture


@dataclass(frozen=True, kw_only=True, config=STRICT)
class InspectConfig:
    """Keys of ``conf/inspect.yaml``."""

    file: Calibration
    images: Text | None
    frame: Annotated[int | str | None, OnlyWith("images")]
    cameras: Names | None
    masks: Text | None
    depths: Annotated[list[Distance], MinLen(1)]
    picture_depths: list[Distance]
    level: Number
    output: Text


def print_cameras(rig: CameraRig, title: str) -> None:
    """Print a row for each camera: model, size, fields of view and focal length."""
    rows = []
    for name, camera in rig.cameras.items():
        height, width = camera.image_size
        angles = [f"{math.degrees(angle):.1f}°" for angle in field_of_view(camera)]
        along_u, along_v = focal_length_on_axis(camera).tolist()
        focal_length = f"{along_u:.1f}" if abs(along_u - along_v) < 0.05 else f"{along_u:.1f} {along_v:.1f}"
        rows.append([name, camera.model, f"{width} x {height}", *angles, focal_length])
    print_table(title, ["camera", "model", "w x h", "across", "down", "widest", "px/rad on axis"], rows)


def print_poses(rig: CameraRig, config: InspectConfig) -> None:
    """Print where the cameras are and look, their distances, and their overlap at each depth."""
    rows = []
    for name, position, axis in zip(rig.names, rig.positions - rig.center, rig.axes, strict=True):
        numbers = (
            [f"{value:+.3f}" for value in position.tolist()],
            [f"{value:+.2f}" for value in axis.tolist()],
        )
        rows.append([name, *(" ".join(group) for group in numbers)])
    columns = ["camera", "position from the centre (m)", "optical axis"]
    print_table("poses in the rig: x right, y down, z forward", columns, rows)
    baselines = rig.baselines.tolist()
    rows = [
        [name, *(f"{value:.3f}" for value in row)] for name, row in zip(rig.names, baselines, strict=True)
    ]
    print_table("baselines (m)", ["", *rig.names], rows)
    sphere = Icosphere(config.level)
    seen = overlap(coverage(rig, sphere.vertices, config.depths), sphere.solid_angles)
    rows = [
        [
            "far away" if math.isinf(depth) else f"{depth:g}",
            f"{100 * one:.1f} %",
            f"{100 * two:.1f} %",
            f"{mean:.2f}",
        ]
        for depth, one, two, mean in zip(config.depths, *(values.tolist() for values in seen), strict=True)
    ]
    columns = ["depth (m)", "seen", "by two or more", "cameras on average"]
    print_table("share of the sphere that the rig sees, from its centre", columns, rows)


def save_pictures(
    rig: CameraRig, has_poses: bool, images: Mapping[str, Tensor], config: InspectConfig, folder: Path
) -> list[Path]:
    """Write the angle map of each camera and, where poses are known, the rig and its coverage; returns the files."""
    written = []
    for name, camera in rig.cameras.items():
        title = f"{name}: {type(camera).__name__}, {camera.image_size[1]} x {camera.image_size[0]}"
        written.append(folder / f"angles_{part_of_name(name)}.png")
        write_image(written[-1], angle_map(camera, images.get(name), rig.masks.get(name), title))
    if not has_poses:
        return written
    written.append(folder / "rig.png")
    write_image(written[-1], rig_picture(rig))
    for depth in config.picture_depths:
        written.append(folder / f"coverage_{'far' if math.isinf(depth) else f'{depth:g}m'}.png")
        write_image(written[-1], coverage_panorama(rig, depth, title=Path(config.file.calibration).name))
    return written


def inspect(config: InspectConfig, folder: Path) -> list[Path]:
    """Print fields of view, poses and overlap of ``config.file``, write pictures to ``folder``; returns the files."""
    models, posed_rig = config.file.cameras_and_rig()
    whole = posed_rig or CameraRig(models, torch.eye(4).repeat(len(models), 1, 1))  # a camera is a rig of one
    names, labels = cameras_and_labels(config.cameras, whole)
    cameras = names or list(whole.names)
    rig = whole.subset(cameras)
    files: list[Path] = []
    if config.masks is not None:
        rig, files = rig_with_masks(whole, config.masks, cameras)
        rig = rig.subset(cameras)
    images: Mapping[str, Tensor] = {}
    if config.images is not None:
        frames = None if config.frame is None else [config.frame]
        with keys_named(frames="frame"):
            source = open_source(config.images, whole, frames, files, cameras, labels=labels)
        print_labels(source)
        samples = [frame.images for frame in source.samples() if frame.images]
        if not samples:
            error = None if source.live else next(source.frames(Selection(), lambda _: True)).error
            raise error or ArgumentError("images: expected a recording, not live cameras")
        images = as_photographs(samples[0], rig)
        source.rig = rig
        cut_to_visible(source, config.file.max_angle_deg)
        rig = source.rig
    print_cameras(rig, str(config.file.calibration))
    if posed_rig is not None:
        print_poses(rig, config)
    else:
        console.print("The file has no poses, so baselines and overlap are not known.")
    written = save_pictures(rig, posed_rig is not None, images, config, folder)
    for path in written:
        print(path)
    return written
