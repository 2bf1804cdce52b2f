# SPDX-License-Identifier: Apache-2.0
"""Depth of one's own captures: picture, point cloud and arrays of each frame."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from omegaconf import DictConfig
from rich.progress import track
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError, FileFormatError, check_choice
from sphericalvision.data import ToSphere
from sphericalvision.data.seen import pixels_seen
from sphericalvision.io.images import read_image
from sphericalvision.models import DepthNetwork, SemiGlobalSweep
from sphericalvision.recipes.app.captures import Capture, find_capture, find_masks, read_frame
from sphericalvision.recipes.app.checkpoints import load_network
from sphericalvision.recipes.app.cli import choose_device, console, print_config
from sphericalvision.recipes.app.results import estimate_depth, save_result
from sphericalvision.recipes.app.rigs import rig_from_file
from sphericalvision.sweep.nearest_depth import nearest_depth

__all__ = ["load_rig", "network_for", "predict"]


class Prepared(NamedTuple):
    """Images of one frame as a network takes them, and what of them was seen."""

    images: Tensor
    seen: Tensor


def load_rig(config: DictConfig) -> CameraRig:
    """Read the calibration, take the cameras asked for, and put the masks on."""
    rig = rig_from_file(config.calibration, config.translation_unit, config.max_angle_deg)
    if config.cameras is not None:
        rig = rig.subset(list(config.cameras))
    if config.masks is None:
        return rig
    masks: dict[str, Tensor] = {}
    for name, path in find_masks(config.masks, rig.names).items():
        masks[name] = read_image(path, rig.cameras[name].image_size, f"the mask of camera {name}")[0] > 0.5
    return CameraRig(rig.cameras, rig.world_from_camera, masks=masks)


def network_for(rig: CameraRig, config: DictConfig) -> DepthNetwork:
    """Load the network at the scale of ``rig``, or the sweep without training that stands in its place.

    Scaling a rig and everything around it changes no image. A network that was trained with one ring of cameras
    serves any larger or smaller rig once its nearest hypothesis is scaled alike: that is ``min_depth=auto``.

    Raises:
        ArgumentError: the network wants another number of cameras, or ``min_depth`` is no number.
    """
    check_choice("method", config.method, ("network", "semi_global"))
    training_free = config.method == "semi_global"  # its level is the network's unless given
    net = load_network(config.checkpoint, None if training_free else config.level)
    if len(rig) != net.num_cameras and not net.any_cameras:
        raise ArgumentError(
            f"calibration: {config.calibration} has {len(rig)} cameras ({', '.join(rig.names)}), the "
            f"checkpoint is for {net.num_cameras}; choose {net.num_cameras} with cameras=[...], or train a network "
            f"with model.num_cameras={len(rig)}"
        )
    net = net.with_changes(min_depth=nearest_hypothesis(net, rig, config)).configure(native=config.native)
    if training_free:
        level = config.level or (net.level if net.images == "sphere" else 5)
        number = config.num_hypotheses or net.num_hypotheses
        net = SemiGlobalSweep(level, number, net.min_depth, depth_coarsening=1)
    elif config.num_hypotheses is not None:
        net = net.with_changes(num_hypotheses=config.num_hypotheses)
    return net.eval().to(choose_device(config.device))


def nearest_hypothesis(net: DepthNetwork, rig: CameraRig, config: DictConfig) -> float:
    """``config.min_depth`` in metres; ``auto`` is what the network was trained with, scaled as the rig is.

    Raises:
        ArgumentError: another word, or the rig has no size to scale by.
    """
    if config.min_depth != "auto":
        if isinstance(config.min_depth, str):
            raise ArgumentError(
                f"min_depth: expected a number of metres, auto or scene, got {config.min_depth!r}"
            )
        return float(config.min_depth)
    radius = float(rig.radius)
    if not radius > 0:
        raise ArgumentError(
            f"min_depth: auto scales with the rig, and {config.calibration} has all its cameras in one place "
            f"({', '.join(rig.names)}); give metres, min_depth=0.55, or more cameras"
        )
    return net.min_depth * radius / float(config.trained_radius)


def nearest_in_scene(capture: Capture, rig: CameraRig, config: DictConfig) -> float:
    """The nearest hypothesis in metres that suits what is seen, from quick sweeps of up to three frames."""
    frames = list(capture.files.values())
    chosen = [frames[number] for number in sorted({0, len(frames) // 2, len(frames) - 1})]
    to_sphere = ToSphere(SCENE_LEVEL, antialias=config.antialias)
    images = torch.stack([to_sphere.images(read_frame(files, rig), rig) for files in chosen])
    return nearest_depth(images, rig, to_sphere.seen(rig))


def prepare(net: DepthNetwork, images: Mapping[str, Tensor], rig: CameraRig, antialias: bool) -> Prepared:
    """Images by camera name, and what was seen, as the network wants them."""
    if net.images == "sphere":
        to_sphere = ToSphere(net.level, antialias=antialias)
        return Prepared(to_sphere.images(images, rig), to_sphere.seen(rig))
    sizes = sorted({tuple(image.shape[-2:]) for image in images.values()})
    if len(sizes) > 1:
        raise ArgumentError(f"images: {type(net).__name__} wants images of one size, got {sizes}")
    seen = torch.stack(list(pixels_seen(rig).values()))
    stacked = torch.stack([images[name] for name in rig.names]) * 2 - 1
    return Prepared(stacked * seen[:, None], seen)


def predict(config: DictConfig, folder: Path) -> list[Path]:
    """Write picture, point cloud and arrays of each frame to ``folder``; returns the files.

    Raises:
        FileFormatError: images of some frames cannot be read; the others are done before that is told.
    """
    check_choice("on_error", config.on_error, ("skip", "stop"))
    rig = load_rig(config)
    masks = () if config.masks is None else find_masks(config.masks, rig.names).values()
    capture = find_capture(config.images, rig.names, config.frames, leave_out=masks)
    if config.min_depth == "scene":
        config.min_depth = round(nearest_in_scene(capture, rig, config), 3)
    net = network_for(rig, config)
    print_config(config, folder)
    console.print(
        f"{len(capture.files)} frame(s), {len(rig)} cameras, rig radius {float(rig.radius):.3f} m, "
        f"nearest hypothesis {net.min_depth:.3f} m"
    )
    written, wrong, seen = [], [], []
    for frame, files in track(todo(capture, folder, config).items(), "estimating depth", console=console):
        try:
            images = read_frame(files, rig)
        except (FileFormatError, OSError) as error:
            if config.on_error == "stop":
                raise
            wrong.append(str(error))
            console.print(f"left out: {error}", style="yellow", highlight=False, soft_wrap=True)
            continue
        prepared = prepare(net, images, rig, config.antialias)
        result = estimate_depth(net, prepared.images, rig, config.height, prepared.seen)
        seen.append(result.share_matched)
        written += save_result(folder, prefix_of(frame), result, images, rig)
    for path in written:
        print(path)
    if seen and min(seen) < ENOUGH:
        print(
            f"Two cameras see {100 * min(seen):.0f} % of all directions at the depth estimated. Elsewhere nothing can "
            "be measured: grey in depth.png, left out of points.ply, False in matched_panorama of depth.npz."
        )
    if wrong:
        raise FileFormatError(
            f"{len(wrong)} of {len(capture.files)} frames were left out. The first: {wrong[0]}"
        )
    return written


SCENE_LEVEL = 6
"""Icosphere level of the images that ``min_depth=scene`` looks at."""
ENOUGH = 0.98
"""Share of the sphere that two cameras see, below which it is said."""


def prefix_of(frame: str) -> str:
    """What the names of a frame's files begin with."""
    return f"{frame}_" if frame else ""


def todo(capture: Capture, folder: Path, config: DictConfig) -> dict[str, Mapping[str, Path]]:
    """The frames that are to be done: with ``skip_existing`` those whose last file is not there yet."""
    frames = dict(capture.files)
    if config.skip_existing:
        frames = {
            f: files for f, files in frames.items() if not (folder / f"{prefix_of(f)}depth.npz").is_file()
        }
        console.print(f"{len(capture.files) - len(frames)} frame(s) are in {folder} already", soft_wrap=True)
    return frames
