# SPDX-License-Identifier: Apache-2.0
"""What a frame of training data costs: rendered, and read back."""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Callable, Iterator

import torch
from omegaconf import DictConfig

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.data import SampleView
from sphericalvision.recipes.speed.measuring import Comparison
from sphericalvision.scenes import World, WorldSamples
from sphericalvision.scenes.procedural import make_scene, render_rig
from sphericalvision.scenes.registry import scene_kinds

__all__ = ["data"]


def data(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """Rendering of ``num_frames`` seeds in turn, scenes included, and frames out of the cache of rendered ones."""
    rig = ring_rig(4, image_size=tuple(config.image_size))
    height, width = config.image_size
    yield Comparison(
        f"rendering: four images of {height} x {width}, one ray a pixel",
        {kind: _rendering(kind, rig, config.num_frames) for kind in scene_kinds()},
    )
    level, _ = config.settings[0]
    with tempfile.TemporaryDirectory() as folder:
        view = SampleView(level, level - 2)
        scenes = WorldSamples(World(rig), view, range(config.num_frames), folder)
        for index in range(len(scenes)):
            scenes[index]
        turns = itertools.cycle(range(len(scenes)))
        yield Comparison(f"level {level}: one frame out of the cache", {"read": lambda: scenes[next(turns)]})


def _rendering(kind: str, rig: CameraRig, number: int) -> Callable[[], object]:
    turns = itertools.cycle(range(number))
    return lambda: render_rig(make_scene(kind, next(turns)), rig)
