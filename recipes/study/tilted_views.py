# SPDX-License-Identifier: Apache-2.0
"""The frames of a study: the same scenes through cameras tilted by each angle, or through 360° cameras."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf
from torch.utils.data import Dataset, Subset

from sphericalvision.cameras import CameraRig
from sphericalvision.cameras.fingerprint import rig_fingerprint
from sphericalvision.core import ArgumentError
from sphericalvision.data import RotateFisheye, SampleView
from sphericalvision.data.sample_view import ToView
from sphericalvision.recipes.app.cli import build
from sphericalvision.recipes.datamodules.data_module import Sample, SampleDataModule
from sphericalvision.recipes.datamodules.depth_data_module import DepthDataModule
from sphericalvision.recipes.datamodules.omnistereo import OmniStereoDataModule
from sphericalvision.recipes.evaluation.frames import SampleFrames

__all__ = ["View", "view_frames", "views"]


class View(NamedTuple):
    """The cameras that see the frames, and by how many degrees they are tilted down."""

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


class Samples(NamedTuple):
    """Samples of a view, the module that loads them, and their identity: whatever they depend on."""

    data: SampleDataModule
    samples: Dataset[Sample]
    identity: list[str]


def view_frames(config: DictConfig, view: View) -> SampleFrames:
    """The frames of a view, with ``images`` on the icosphere, ``fisheye`` images and ground truth.

    Raises:
        ArgumentError: ``panel_frame`` is none of them.
    """
    data, samples, identity = (_rendered if "rig" in config.data else _on_disk)(config, view)
    count = len(samples)  # type: ignore[arg-type]
    if config.frames is not None:
        count = min(config.frames, count)
    if not 0 <= config.panel_frame < count:
        raise ArgumentError(f"panel_frame: expected 0 to {count - 1}, got {config.panel_frame}")
    return SampleFrames(
        lambda indices: data.loader(Subset(samples, indices)),
        count,
        view.name,
        [config.panel_frame],
        {"samples": identity},
    )


def _rendered(config: DictConfig, view: View) -> Samples:
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
    _set_view(data, config)
    data.render("test")
    samples = data.dataset("test")
    world = samples.world
    first = world.frame(samples.seeds[0]).name
    return Samples(data, samples, [world.fingerprint(samples.view), repr(world.meshes), first])


def _on_disk(config: DictConfig, view: View) -> Samples:
    data = build(config.data, "data")
    if not isinstance(data, OmniStereoDataModule):
        raise ArgumentError("data: expected data=fisheye_scenes, or a set on disk such as data=omnihouse")
    size = None if config.image_size is None else [int(side) for side in config.image_size]
    _set_view(data, config)
    samples = data.read(
        "test", RotateFisheye(tilt=math.radians(view.angle_deg), image_size=size), ToView(data.view)
    )
    return Samples(
        data, samples, [rig_fingerprint(samples.rig, (samples, samples.frames, data.view, view, size))]
    )


def _set_view(data: DepthDataModule, config: DictConfig) -> None:
    """Let samples hold what networks of all kinds take."""
    level = config.model.level
    data.view, data.min_depth = SampleView(level, level - 2, True, (80, 160)), config.model.min_depth
