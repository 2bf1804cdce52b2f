# SPDX-License-Identifier: Apache-2.0
"""Depth of one's own captures: picture, point cloud and arrays of each frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from omegaconf import DictConfig
from rich.progress import track
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.data import ToSphere
from sphericalvision.io.images import read_image
from sphericalvision.models import IcoSweepNet, OmniMVS
from sphericalvision.recipes.app.captures import find_capture, find_masks, read_frame
from sphericalvision.recipes.app.checkpoints import load_network
from sphericalvision.recipes.app.cli import choose_device, console, print_config
from sphericalvision.recipes.app.results import estimate_depth, save_result
from sphericalvision.recipes.app.rigs import rig_from_file
from sphericalvision.recipes.datamodules.entries import ChosenEntries
from sphericalvision.recipes.evaluation.training_free import SemiGlobalSweep

__all__ = ["load_rig", "network_for", "predict"]


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


def network_for(rig: CameraRig, config: DictConfig) -> IcoSweepNet | OmniMVS:
    """Load the network at the scale of ``rig``.

    Scaling a rig and everything around it changes no image. A network that was trained with one ring of cameras
    serves any larger or smaller rig once its nearest hypothesis is scaled alike: that is ``min_depth=auto``.

    Raises:
        ArgumentError: the network wants another number of cameras, or ``min_depth`` is no number.
    """
    net = load_network(config.checkpoint, config.level)
    expected = net.hyperparameters["num_cameras"]
    if len(rig) != expected and not net.any_cameras:
        raise ArgumentError(
            f"calibration: {config.calibration} has {len(rig)} cameras ({', '.join(rig.names)}), the "
            f"checkpoint is for {expected}; choose {expected} with cameras=[...], or train a network with "
            f"model.num_cameras={len(rig)}"
        )
    min_depth = config.min_depth
    if min_depth == "auto":
        min_depth = net.hyperparameters["min_depth"] * float(rig.radius) / config.trained_radius
    if isinstance(min_depth, str) or not min_depth > 0:
        raise ArgumentError(
            f"min_depth: expected a positive number of metres or auto, got {config.min_depth!r}"
        )
    net = load_network(config.checkpoint, config.level, float(min_depth), config.native)
    return net.to(choose_device(config.device))


def image_preparation(
    net: IcoSweepNet | OmniMVS | SemiGlobalSweep, antialias: bool
) -> Callable[[Mapping[str, Tensor], CameraRig], Tensor]:
    """What makes images by camera name into those that the network wants."""
    if not isinstance(net, OmniMVS):
        return ToSphere(net.level, antialias=antialias).images
    to_entry = ChosenEntries(("fisheye",), level=2)
    return lambda images, rig: to_entry({"images": images, "rig": rig})["fisheye"]  # type: ignore[no-any-return]


def predict(config: DictConfig, folder: Path) -> list[Path]:
    """Write picture, point cloud and arrays of each frame to ``folder``; returns the files."""
    check_choice("method", config.method, ("network", "semi_global"))
    rig = load_rig(config)
    capture = find_capture(config.images, rig.names, config.frames)
    net: IcoSweepNet | OmniMVS | SemiGlobalSweep = network_for(rig, config)
    if config.method == "semi_global":
        net = SemiGlobalSweep.like(net)
    print_config(config, folder)
    console.print(
        f"{len(capture.files)} frame(s), {len(rig)} cameras, rig radius {float(rig.radius):.3f} m, "
        f"nearest hypothesis {net.min_depth:.3f} m"
    )
    prepare = image_preparation(net, config.antialias)
    written = []
    for frame, files in track(capture.files.items(), "estimating depth", console=console):
        images = read_frame(files, rig)
        result = estimate_depth(net, prepare(images, rig), rig, config.height)
        written += save_result(folder, f"{frame}_" if frame else "", result, images, rig)
    for path in written:
        print(path)
    return written
