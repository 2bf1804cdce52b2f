# SPDX-License-Identifier: Apache-2.0
"""What a study evaluates on: the same frames through cameras tilted by each angle, or through 360° cameras."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor
from torch.utils.data import Dataset, Subset

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError
from sphericalvision.data import RotateFisheye, SampleView
from sphericalvision.data.sample_view import ToView
from sphericalvision.recipes.app.cli import build
from sphericalvision.recipes.datamodules.data_module import Sample, SampleDataModule
from sphericalvision.recipes.datamodules.depth_data_module import DepthDataModule
from sphericalvision.recipes.datamodules.omnistereo import OmniStereoDataModule
from sphericalvision.recipes.evaluation.frames import SampleFrames
from sphericalvision.recipes.study.training import CHANGES_NOTHING
from sphericalvision.recipes.training.run_folder import flat_settings

__all__ = ["View", "training_depths", "view_frames", "views"]


class View(NamedTuple):
    """How the frames are seen: through which rig, and tilted down by how many degrees."""

    inputs: str
    angle_deg: float

    @property
    def name(self) -> str:
        """For file names."""
        return f"{self.inputs}-{self.angle_deg:g}deg"


def views(config: DictConfig) -> list[View]:
    """All views of a study: every angle and, with ``inputs=equirect``, the level rig of 360° cameras.

    Raises:
        ArgumentError: the same angle twice.
    """
    angles = [float(angle) for angle in config.angles_deg]
    if len(set(angles)) != len(angles):
        raise ArgumentError(f"angles_deg: expected each angle once, got {angles}")
    fisheye = [View("fisheye", angle) for angle in sorted(angles)]
    if config.inputs == "fisheye":
        return fisheye
    if "rig" not in config.data:
        raise ArgumentError(
            "inputs=equirect: sees the same scenes through other cameras, which takes rendered scenes "
            "(data=fisheye_scenes); images on disk have the cameras that they have"
        )
    level = [] if 0.0 in angles else [View("fisheye", 0.0)]
    return [*level, *fisheye, View("equirect", 0.0)]


def view_frames(config: DictConfig, view: View) -> SampleFrames:
    """The frames of a view, with ``images`` on the icosphere, ``fisheye`` images and ground truth.

    Raises:
        ArgumentError: ``panel_frame`` is none of them.
    """
    data, frames = _rendered(config, view) if "rig" in config.data else _on_disk(config, view)
    number = len(frames) if config.frames is None else min(config.frames, len(frames))  # type: ignore[arg-type]
    if not 0 <= config.panel_frame < number:
        raise ArgumentError(f"panel_frame: expected 0 to {number - 1}, got {config.panel_frame}")
    return SampleFrames(
        lambda numbers: data.loader(Subset(frames, numbers)),
        number,
        view.name,
        [config.panel_frame],
        view_key(config, view),
    )


NO_MATTER = ("batch_size", "rig.", "entries", "seed", "num_test", "panorama_size", "num_train", "num_val")
"""Beginnings of keys of the data that leave an evaluation as it is, or that the study sets by itself."""


def view_key(config: DictConfig, view: View) -> dict[str, Any]:
    """What the frames of a view depend on."""

    def plain(node: Any) -> Any:
        return OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node

    flat = flat_settings(OmegaConf.create({"data": plain(config.data)}), CHANGES_NOTHING)
    key = {k: v for k, v in flat.items() if not k.removeprefix("data.").startswith(NO_MATTER)}
    key |= {name: plain(config[name]) for name in ("image_size", "panorama_size", "panel_frame")}
    key["level"] = config.model.level
    if "rig" in config.data:
        fisheye = view.inputs == "fisheye"
        key["rig"] = plain(config.rig if fisheye else config.equirect_rig)
        key["equirect_size"] = None if fisheye else plain(config.equirect_size)
    return key


def _rendered(config: DictConfig, view: View) -> tuple[SampleDataModule, Dataset[Sample]]:
    rig: CameraRig = build(config.rig if view.inputs == "fisheye" else config.equirect_rig, "rig")
    size = config.image_size if view.inputs == "fisheye" else config.equirect_size
    if size is not None:
        rig = rig.resized([int(side) for side in size])
    node: dict[str, Any] = OmegaConf.to_container(config.data, resolve=True)  # type: ignore[assignment]
    if "entries" not in node:
        raise ArgumentError(
            "data: expected data=fisheye_scenes, whose samples hold fisheye images, or a set on disk"
        )
    node |= {"augment": False, "panorama_size": list(config.panorama_size)}
    if config.frames is not None:
        node["num_test"] = config.frames
    del node["rig"]
    data = build(node, "data", rig=rig.rotated(tilt=math.radians(view.angle_deg)))
    _show(data, config)
    data.render("test")
    return data, data.dataset("test")


def _on_disk(config: DictConfig, view: View) -> tuple[SampleDataModule, Dataset[Sample]]:
    data = build(config.data, "data")
    if not isinstance(data, OmniStereoDataModule):
        raise ArgumentError("data: expected data=fisheye_scenes, or a set on disk such as data=omnihouse")
    size = None if config.image_size is None else [int(side) for side in config.image_size]
    turned = RotateFisheye(tilt=math.radians(view.angle_deg), image_size=size)
    _show(data, config)
    return data, data.read("test", turned, ToView(data.view))


def _show(data: DepthDataModule, config: DictConfig) -> None:
    """Let samples hold what networks of all kinds take."""
    level = config.model.level
    data.view, data.min_depth = SampleView(level, level - 2, True, (80, 160)), config.model.min_depth


def training_depths(training: DictConfig, level: int, most: int) -> tuple[Tensor, Tensor]:
    """Inverse depth and validity ``(F, V_{level-2})`` of at most ``most`` frames that a training has, evenly chosen."""
    data = build(training.data, "data")
    data.view, data.min_depth = SampleView(depth_level=level - 2), training.model.min_depth
    frames: Dataset[Sample] = data.plain_train_dataset()
    total = len(frames)  # type: ignore[arg-type]
    chosen = range(0, total, max(1, -(-total // most)))
    samples = [frames[index] for index in chosen]
    return torch.stack([s["inverse_depth"] for s in samples]), torch.stack([s["valid"] for s in samples])
