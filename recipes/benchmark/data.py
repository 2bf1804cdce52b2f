# SPDX-License-Identifier: Apache-2.0
"""Whether data come as fast as training takes them: rendering, reading back, and the time that training waits."""

from __future__ import annotations

import itertools
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch
from omegaconf import DictConfig
from torch.utils.data import DataLoader

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.data.collate import collate_samples
from sphericalvision.losses import depth_index_huber
from sphericalvision.models import IcoSweepNet
from sphericalvision.recipes.benchmark.measuring import Comparison
from sphericalvision.scenes import SceneDataset
from sphericalvision.scenes.recipes import make_scene, render_rig
from sphericalvision.scenes.registry import scene_kinds
from sphericalvision.sweep import index_from_inverse_depth

__all__ = ["comparisons"]

LIMIT = 20 * 60 * 2 / 1000
"""CPU seconds a frame for 1,000 frames in 20 minutes on two cores."""


def comparisons(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """Rendering through ``ring_rig``, then training at the first setting on the frames that were rendered."""
    rig = ring_rig(4, image_size=tuple(config.image_size))
    yield _rendering(rig, config.num_frames)
    level, number = config.settings[0]
    with tempfile.TemporaryDirectory() as folder:
        scenes = SceneDataset(config.num_frames, rig, level, "mixed", cache_dir=folder)
        for index in range(len(scenes)):
            scenes[index]
        turns = itertools.cycle(range(len(scenes)))
        yield Comparison(
            f"level {level}: one frame out of the cache", {"read": lambda: scenes[next(turns)]}, "read"
        )
        yield _waiting(scenes, level, number, config.feature_channels, device)


def _rendering(rig: CameraRig, num_frames: int) -> Comparison:
    height, width = next(iter(rig.cameras.values())).image_size
    turns = {kind: itertools.cycle(range(num_frames)) for kind in scene_kinds()}

    def frame(kind: str) -> float:
        start = time.process_time()
        render_rig(make_scene(kind, next(turns[kind])), rig)
        return time.process_time() - start

    return Comparison(
        f"rendering: four images of {height} x {width}, one ray a pixel",
        {kind: partial(frame, kind) for kind in scene_kinds()},
        scene_kinds()[0],
        note=f"CPU time of frames of seeds 0 to {num_frames - 1}, scenes included. A thousand in 20 minutes on two "
        f"cores are {LIMIT:.1f} s of one core each.",
        unit="reported s",
        rounds=num_frames,
    )


def _waiting(
    scenes: SceneDataset, level: int, number: int, channels: int, device: torch.device
) -> Comparison:
    """Share of a run over all frames in which training has nothing to do."""
    workers = min(2, os.cpu_count() or 1)
    return Comparison(
        f"level {level} to {level - 2}, N = {number}: training that waits for its data",
        {
            "in the same process": partial(_share, scenes, level, number, channels, device, 0),
            f"{workers} workers": partial(_share, scenes, level, number, channels, device, workers),
        },
        "in the same process",
        unit="%",
        note=f"Batches of one, {len(scenes)} frames from the cache; the first, for which workers start, not counted.",
    )


def _share(
    scenes: SceneDataset, level: int, number: int, channels: int, device: torch.device, workers: int
) -> float:
    step = _step(IcoSweepNet(level, number, scenes.min_depth, channels).to(device).train(), scenes, device)
    loader = DataLoader(scenes, batch_size=1, num_workers=workers, collate_fn=collate_samples)
    waited, worked, batches = 0.0, 0.0, iter(loader)
    step(next(batches))
    while True:
        start = time.perf_counter()
        batch = next(batches, None)
        if batch is None:
            return 100 * waited / max(waited + worked, 1e-9)
        middle = time.perf_counter()
        step(batch)
        waited, worked = waited + middle - start, worked + time.perf_counter() - middle


def _step(net: IcoSweepNet, scenes: SceneDataset, device: torch.device) -> Callable[[dict[str, Any]], None]:
    """A training step as of the recipes, on frames of one rig."""
    tables = net.sweep.tables(scenes.rig.to(device))
    optimizer = torch.optim.Adam(net.parameters(), lr=1e-4)

    def step(batch: dict[str, Any]) -> None:
        inverse_depth, valid = batch["inverse_depth"].to(device), batch["valid"].to(device)
        target = index_from_inverse_depth(inverse_depth, net.num_hypotheses, net.min_depth)
        loss = depth_index_huber(net(batch["images"].to(device), tables), target, valid)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        loss.item()  # waits for the device

    return step
