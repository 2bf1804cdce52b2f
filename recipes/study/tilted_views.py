# SPDX-License-Identifier: Apache-2.0
"""The frames of a study: the same scenes through cameras tilted by each angle, or through 360° cameras."""

import math
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf
from torch.utils.data import Subset

from sphericalvision.cameras import CameraRig
from sphericalvision.cameras.fingerprint import rig_fingerprint
from sphericalvision.core import ArgumentError
from sphericalvision.data import RotateFisheye, SampleView
from sphericalvision.data.sample_view import ToView
from sphericalvision.recipes.app.cli import build
from sphericalvision.recipes.datamodules.omnistereo import OmniStereoDataModule
from sphericalvision.recipes.datamodules.scenes import SceneDataModule
from sphericalvision.recipes.evaluation.loop import SampleFrames


class View(NamedTuple):
    """The cameras that see the frames, and by how many degrees they are tilted down."""

    inputs: str
    angle_deg: float

    @property
    def name(self) -> str:
        """Name of the view in files."""
        return f"{self.inputs}-{self.angle_deg:g}deg"


def views(config: DictConfig) -> list[View]:
    """All views of a study: every angle and, with ``inputs=equirect``, the level rig of 360° cameras."""
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
    """The frames of a view, with ``images`` on the icosphere, ``fisheye`` images and ground truth."""
    size = config.image_size if view.inputs == "fisheye" else config.equirect_size
    size = None if size is None else [int(side) for side in size]
    level, is_rendered = config.model.level, "rig" in config.data
    data: Any = _rendered(config, view, size) if is_rendered else build(config.data, "data")
    # What networks of all kinds take.
    data.view, data.min_depth = SampleView(level, level - 2, True, (80, 160)), config.model.min_depth
    samples: Any
    if is_rendered:
        data.render("test")
        samples = data.dataset("test")
        world = samples.world
        first = world.frame(samples.seeds[0]).name
        identity = [world.fingerprint(samples.view), repr(world.meshes), first]
    elif isinstance(data, OmniStereoDataModule):
        rotate = RotateFisheye(tilt=math.radians(view.angle_deg), image_size=size)
        samples = data.read("test", rotate, ToView(data.view))
        identity = [rig_fingerprint(samples.rig, (samples, samples.frames, data.view, view, size))]
    else:
        raise ArgumentError("data: expected data=fisheye_scenes, or a set on disk such as data=omnihouse")
    count = len(samples) if config.frames is None else min(config.frames, len(samples))
    if config.panel_frame >= count:
        raise ArgumentError(f"panel_frame: expected 0 to {count - 1}, got {config.panel_frame}")
    return SampleFrames(
        lambda indices: data.loader(Subset(samples, indices)),
        count,
        view.name,
        [config.panel_frame],
        {"samples": identity},
    )


def _rendered(config: DictConfig, view: View, size: list[int] | None) -> SceneDataModule:
    """Scenes through the rig of a view, with images of a size."""
    rig: CameraRig = build(config.rig if view.inputs == "fisheye" else config.equirect_rig, "rig")
    if size is not None:
        rig = rig.resized(size)
    node: dict[str, Any] = OmegaConf.to_container(config.data, resolve=True)  # type: ignore[assignment]
    if "entries" not in node:
        raise ArgumentError(
            "data: expected data=fisheye_scenes, whose samples hold fisheye images, or a set on disk"
        )
    node |= {"augment": False, "panorama_size": list(config.panorama_size)}
    if config.frames is not None:
        node["num_test"] = config.frames
    del node["rig"]
    data: SceneDataModule = build(node, "data", rig=rig.rotated(tilt=math.radians(view.angle_deg)))
    return data
