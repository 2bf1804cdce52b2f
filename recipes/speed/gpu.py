# SPDX-License-Identifier: Apache-2.0
"""What a device with a GPU gives, the figures that matter most first: each is saved as soon as it is there."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from hydra import compose
from omegaconf import DictConfig
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.capture import Predictor
from sphericalvision.capture.graphs import GraphedFunction
from sphericalvision.models import DepthNetwork, IcoSweepNet
from sphericalvision.recipes.app.checkpoints import load_network
from sphericalvision.recipes.commands.train import instantiate_run
from sphericalvision.recipes.speed.measuring import Comparison, Run, added_memory, random_images
from sphericalvision.scenes import make_scene, render_rig

__all__ = ["gpu"]

LEVELS = {"default": 6, "level 5": 5, "level 7": 7}
"""Of the images that the networks which ship are timed at."""
PREDICTORS: dict[str, dict[str, Any]] = {
    "default": {},
    "level 5": {"level": 5},
    "level 7": {"level": 7},
    "default, bfloat16": {"precision": "bfloat16"},
    "default, float16": {"precision": "float16"},
}
BATCH = 16
TRAINING = [
    "experiment=refinedsweepnet/fusion",
    "data=random_rigs",
    "data.cache_dir=null",
    f"data.num_workers={max(1, (os.cpu_count() or 1) - 1)}",
]
"""What samples are trained with, each of them rendered for its step."""
LARGEST = 800
"""Height and width of the images."""


def gpu(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """Parity, a frame, training, batches of frames, memory and rendering, on a device."""
    side = min(LARGEST, max(config.image_sides))
    rig, ring = ring_rig(4, image_size=(side, side)), ring_rig(4).to(device)
    rendered = render_rig(make_scene("room", seed=1), rig)
    images = {name: (255 * image).round().byte() for name, image in rendered.items()}
    yield Comparison(
        "the index on the device and on the CPU, in the mean",
        {name: partial(_difference, rig, images, device, options) for name, options in PREDICTORS.items()},
        unit="hypotheses",
    )
    level, number = config.settings[-1]
    networks: dict[str, Callable[[], DepthNetwork]] = {
        title: partial(load_network, level=level) for title, level in LEVELS.items()
    }
    networks[f"IcoSweepNet {level}/{number}"] = partial(
        IcoSweepNet, level, number, feature_channels=config.feature_channels
    )
    for title, network in networks.items():
        yield Comparison(f"{title}: a forward pass of 1", _forward(network(), ring, 1, device))
    calls: dict[str, Run] = {}
    for name, options in PREDICTORS.items():
        calls[name] = partial(_answer, Predictor(rig, min_depth=0.55, device=device, **options), images)
    yield Comparison(
        f"Predictor: a call with four images of {side} x {side} bytes on the host, until its answer is there",
        _called(calls),
    )
    paper = IcoSweepNet(level, number // 2, feature_channels=config.feature_channels)
    for title, net, batch in (
        (f"IcoSweepNet {level}/{number // 2}", paper, 1),
        ("default", networks["default"](), BATCH),
    ):
        steps = _steps(net, ring, batch, device)
        yield Comparison(f"{title}: a training step of {batch}, without the optimiser", steps)
    steps = {f"{BATCH} samples": _training(device)}
    yield Comparison(f"default: a training step of {BATCH} samples that are rendered for it", steps)
    for title, network in networks.items():
        yield Comparison(f"{title}: a forward pass of {BATCH}", _forward(network(), ring, BATCH, device))
    yield Comparison(
        "memory that a forward pass adds",
        {title: partial(_memory, network, ring, device) for title, network in networks.items()},
        unit="MB",
    )
    small, scene = ring_rig(4, image_size=(256, 256)), make_scene("room", seed=1)
    yield Comparison(
        "four images of 256 x 256 rendered, one ray a pixel",
        {name: partial(render_rig, scene, small.to(name)) for name in dict.fromkeys(("cpu", str(device)))},
    )


def _difference(
    rig: CameraRig, images: dict[str, Tensor], device: torch.device, options: dict[str, Any]
) -> float:
    """How far the index on the device is from the CPU's in float32, in the mean over what is seen."""
    expected = Predictor(rig, min_depth=0.55, level=options.get("level"))(images)
    depth = Predictor(rig, min_depth=0.55, device=device, **options)(images)
    return float((depth.index.cpu() - expected.index)[expected.seen].abs().mean())


def _forward(net: DepthNetwork, rig: CameraRig, batch: int, device: torch.device) -> dict[str, Run]:
    """A forward pass through tables that are there: eager, as a CUDA graph, without one of our kernels, in less."""
    net = net.to(device).eval()
    images, tables = random_images(net.level, device, batch), net.tables(rig)

    def forward(within: Callable[[], AbstractContextManager[Any]], inputs: Tensor) -> Tensor:
        with torch.inference_mode(), within():
            return net(inputs, tables)

    reduced = partial(torch.autocast, device.type, cache_enabled=False)
    ways: dict[str, Callable[[], AbstractContextManager[Any]]] = {
        "float32": nullcontext,
        "float32, hexagons by operators of torch": partial(
            mock.patch, "sphericalvision.kernels.runs_triton", return_value=False
        ),
        "bfloat16": partial(reduced, torch.bfloat16),
        "float16": partial(reduced, torch.float16),
    }
    runs: dict[str, Run] = {"eager": partial(forward, nullcontext, images)}
    for name, within in ways.items():
        run = partial(forward, within)
        if device.type == "cuda":
            runs[f"graph, {name}"] = partial(GraphedFunction(name, run), images)
        else:
            runs[name] = partial(run, images)
    return _called(runs)


def _called(runs: dict[str, Run]) -> dict[str, Run]:
    """The same after a first call: a CUDA graph is captured at the second, with which measuring begins."""
    for run in runs.values():
        run()
    return runs


def _steps(net: DepthNetwork, rig: CameraRig, batch: int, device: torch.device) -> dict[str, Run]:
    """Forward and backward pass, in float32 and in bfloat16."""
    net = net.to(device).train()
    images, tables = random_images(net.level, device, batch), net.tables(rig)

    def step() -> None:
        net(images, tables).sum().backward()
        net.zero_grad()

    return {"float32": step, "bfloat16": torch.autocast(device.type, torch.bfloat16)(step)}


def _training(device: torch.device) -> Run:
    """A step of the training of the default network in bfloat16, with samples that processes render beside it."""
    run = instantiate_run(compose("train", [*TRAINING, f"data.batch_size={BATCH}"]), Path("training"))
    module, data = run.module.to(device).train(), run.data
    module.log = lambda *names, **options: None  # there is no trainer to log to
    optimizer = module.configure_optimizers()["optimizer"]
    batches = iter(data.train_dataloader())

    def step() -> None:
        batch = data.transfer_batch_to_device(next(batches), device, 0)
        optimizer.zero_grad()
        with torch.autocast(device.type, torch.bfloat16):
            loss = module.training_step(batch, 0)
        loss.backward()
        optimizer.step()

    return step


def _memory(network: Callable[[], DepthNetwork], rig: CameraRig, device: torch.device) -> float:
    """MB that a forward pass adds to network, images and tables."""
    net = network().to(device).eval()
    run = partial(net, random_images(net.level, device), net.tables(rig))
    return added_memory(torch.inference_mode()(run), device)


def _answer(predictor: Predictor, images: dict[str, Tensor]) -> Tensor:
    return predictor(images).index.cpu()
