# SPDX-License-Identifier: Apache-2.0
"""Small worlds for tests: samples through one rig or random rigs, and frames as sets on disk hold them."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.capture import Depth
from sphericalvision.data import SampleView
from sphericalvision.models import WinnerTakesAll
from sphericalvision.scenes import World, WorldSamples
from sphericalvision.scenes.random_rigs import LevelOrRandomRigs
from sphericalvision.scenes.samples import recorded_sample

RANDOM_RIGS: dict[str, Any] = yaml.safe_load(
    (Path(__file__).resolve().parents[1] / "conf/world/random_rigs.yaml").read_text()
)
"""Arguments of ``World``, and ``level_rigs``, of the training on random rigs."""


SMALL = SampleView(3, 1)


def ball(
    rig: CameraRig,
    level: int = 4,
    min_depth: float = 1.0,
    confidence: float = 1.0,
    images: Mapping[str, Tensor] | None = None,
) -> Depth:
    """Depth of twice the nearest hypothesis all around a rig, with images of noise."""
    net = WinnerTakesAll(level, 8, min_depth, depth_coarsening=0)
    ones = torch.ones(net.grid.num_vertices)
    if images is None:
        images = {name: torch.rand(3, *camera.image_size) for name, camera in rig.cameras.items()}
    return Depth(3.5 * ones, confidence * ones, ones > 0, net, rig, images)


def scenes(
    rig: CameraRig,
    number: int = 1,
    first_seed: int = 0,
    view: SampleView = SMALL,
    cache_dir: Path | None = None,
    **world: Any,
) -> WorldSamples:
    """Samples of scenes that one rig sees."""
    made = World(rig, carrier_counts=True, **world)
    return WorldSamples(made, view, range(first_seed, first_seed + number), cache_dir)


def random_rigs(
    number: int = 1,
    first_seed: int = 0,
    cache_dir: Path | None = None,
    values: Mapping[str, Any] = RANDOM_RIGS,
    prepare: Any = None,
) -> WorldSamples:
    """Samples through random rigs with small images, at level 3."""
    chosen = dict(values)
    rigs = LevelOrRandomRigs(chosen.pop("level_rigs"), (24, 24))
    world = World.of(chosen, rig=rigs, prepare=prepare)
    view = SampleView(3, 3, antialias=True)
    return WorldSamples(world, view, range(first_seed, first_seed + number), cache_dir)


def same(first: Mapping[str, Any], second: Mapping[str, Any]) -> bool:
    """Whether two samples have the same entries, and equal tensors."""
    tensors = [key for key, value in first.items() if isinstance(value, Tensor)]
    return set(first) == set(second) and all(torch.equal(first[key], second[key]) for key in tensors)


def recorded_frames(
    rig: CameraRig, numbers: Iterable[int], height: int = 32, kind: str | Sequence[str] = ("room", "floating")
) -> list[dict[str, Any]]:
    """Frames of scenes for ``write_omnistereo``; the seed of frame 1 is 0."""
    world = World(rig, kind)
    return [
        {**recorded_sample(world.frame(number - 1), height), "frame": f"{number:05d}"} for number in numbers
    ]


def frames_of_noise(
    rig: CameraRig, numbers: Iterable[int], height: int = 16, width: int = 32
) -> list[dict[str, Any]]:
    """Frames whose inverse depth is between infinity and 0.6 m."""
    generator = torch.Generator().manual_seed(0)
    frames = []
    for number in numbers:
        images = {
            name: torch.rand(3, *camera.image_size, generator=generator)
            for name, camera in rig.cameras.items()
        }
        inverse_depth = torch.rand(height, width, generator=generator) / 0.6
        inverse_depth[0] = 0.0
        frames.append({"frame": f"{number:05d}", "images": images, "inverse_depth": inverse_depth})
    return frames
