# SPDX-License-Identifier: Apache-2.0
"""Figures of a device with a GPU, the most important first: each is saved as soon as it is measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import torch
from omegaconf import DictConfig
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.capture import Predictor
from sphericalvision.capture.graphs import GraphedFunction
from sphericalvision.models import DepthNetwork, IcoSweepNet, pretrained
from sphericalvision.recipes.speed.measuring import Comparison, Run, random_images
from sphericalvision.scenes import make_scene, render_rig

LEVELS = {"default": 6, "level 5": 5, "level 7": 7}
"""Levels of the images at which the network that ships is timed."""
PREDICTORS: dict[str, dict[str, Any]] = {
    "default": {},
    "level 5": {"level": 5},
    "level 7": {"level": 7},
    "default, bfloat16": {"precision": "bfloat16"},
    "default, float16": {"precision": "float16"},
}
BATCHES = 1, 16
MAX_SIDE = 800
"""Height and width of the images."""


def gpu(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """Parity, a frame of a ``Predictor``, forward passes and training steps, alone and in batches."""
    side = min(MAX_SIDE, max(config.image_sides))
    rig, ring = ring_rig(4, image_size=(side, side)), ring_rig(4).to(device)
    images = {
        name: (255 * image).byte() for name, image in render_rig(make_scene("room", seed=1), rig).items()
    }

    def predictor(options: Mapping[str, Any], device: torch.device) -> Predictor:
        return Predictor(rig, min_depth=0.55, device=device, **options)

    def difference(options: Mapping[str, Any]) -> float:
        """Difference of the index on the device from the CPU's in float32, in the mean over seen directions."""
        expected = predictor({k: v for k, v in options.items() if k == "level"}, torch.device("cpu"))(images)
        index = predictor(options, device)(images).index.cpu()
        return float((index - expected.index)[expected.seen].abs().mean())

    yield Comparison(
        "the index on the device and on the CPU, in the mean",
        {name: partial(difference, options) for name, options in PREDICTORS.items()},
        unit="hypotheses",
    )
    calls = {name: predictor(options, device) for name, options in PREDICTORS.items()}
    yield Comparison(
        f"Predictor: a call with four images of {side} x {side} bytes on the host, until its answer is there",
        {name: partial(lambda call: call(images).index.cpu(), call) for name, call in calls.items()},
    )
    level, number = config.settings[-1]
    networks: dict[str, Callable[[], DepthNetwork]] = {
        **{
            title: partial(pretrained().with_changes, level=image_level)
            for title, image_level in LEVELS.items()
        },
        f"IcoSweepNet {level}/{number}": partial(
            IcoSweepNet, level, number, feature_channels=config.feature_channels
        ),
    }
    for batch in BATCHES:
        for title, network in networks.items():
            net = network().to(device)
            yield Comparison(f"{title}: a forward pass of {batch}", _forward(net.eval(), ring, batch, device))
        net = networks["default"]().to(device)
        yield Comparison(f"default: a training step of {batch}", _steps(net.train(), ring, batch, device))


def _forward(net: DepthNetwork, rig: CameraRig, batch: int, device: torch.device) -> dict[str, Run]:
    """A forward pass through existing tables: eager, as a CUDA graph, and in half precision."""
    images, tables = random_images(net.level, device, batch), net.tables(rig)

    @torch.inference_mode()
    def forward(inputs: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
        # a cache of casts would outlive the graph that it was filled in
        with torch.autocast(device.type, dtype, dtype != torch.float32, cache_enabled=False):
            return net(inputs, tables)

    runs: dict[str, Run] = {"eager": partial(forward, images)}
    for dtype in (torch.float32, torch.bfloat16, torch.float16):
        name, run = str(dtype).removeprefix("torch."), partial(forward, dtype=dtype)
        graphed = GraphedFunction(name, run) if device.type == "cuda" else run
        graphed(images)  # a CUDA graph is captured at the second call, the warm-up of measuring
        runs[f"graph, {name}" if device.type == "cuda" else name] = partial(graphed, images)
    return runs


def _steps(net: DepthNetwork, rig: CameraRig, batch: int, device: torch.device) -> dict[str, Run]:
    """Forward and backward pass without the optimiser, in float32 and in bfloat16."""
    images, tables = random_images(net.level, device, batch), net.tables(rig)

    def step() -> None:
        net(images, tables).sum().backward()
        net.zero_grad()

    return {"float32": step, "bfloat16": torch.autocast(device.type, torch.bfloat16)(step)}
