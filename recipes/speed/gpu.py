# SPDX-License-Identifier: Apache-2.0
"""What a device with a GPU gives, the figures that matter most first: each is saved as soon as it is there."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Literal, get_args

import torch
from omegaconf import DictConfig
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.capture import Predictor
from sphericalvision.capture.graphs import GraphedFunction
from sphericalvision.models import DepthNetwork, IcoSweepNet, pretrained
from sphericalvision.recipes.speed.measuring import Comparison, Run, added_memory, random_images
from sphericalvision.scenes import make_scene, render_rig

__all__ = ["gpu"]

SHIPPED = {"default": "refinedsweepnet", "level 5": "refinedsweepnet-fast", "level 7": "refinedsweepnet-fine"}
Precision = Literal["float32", "bfloat16", "float16"]
PRECISIONS: tuple[Precision, ...] = get_args(Precision)
BATCHES = (1, 16)
LARGEST = 800
"""Height and width of the images."""


def gpu(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """Parity, a frame, a batch of frames, memory, training and rendering, on a device."""
    side = min(LARGEST, max(config.image_sides))
    rig = ring_rig(4, image_size=(side, side))
    images = {
        name: (255 * image).round().byte()
        for name, image in render_rig(make_scene("room", seed=1), rig).items()
    }
    yield Comparison(
        "the index on the device and on the CPU", _parity(rig, images, device), "In the mean.", "hypotheses"
    )
    ring = ring_rig(4).to(device)
    level, number = config.settings[-1]
    paper = IcoSweepNet(level, number, feature_channels=config.feature_channels)
    networks: dict[str, Callable[[], DepthNetwork]] = {
        title: partial(pretrained, name) for title, name in SHIPPED.items()
    }
    networks |= {f"IcoSweepNet {level}/{number}": lambda: paper}
    for batch in BATCHES:
        for title, network in networks.items():
            yield Comparison(f"{title}: a forward pass of {batch}", _forward(network(), ring, batch, device))
    predictors = {
        precision: Predictor(rig, min_depth=0.55, device=device, precision=precision)
        for precision in PRECISIONS
    }
    for predictor in predictors.values():  # the second call of a size is captured
        for _ in range(2):
            predictor(images)
    yield Comparison(
        f"Predictor: a call with four images of {side} x {side} bytes on the host, until its answer is there",
        {name: partial(_answer, predictor, images) for name, predictor in predictors.items()},
    )
    for title, network in networks.items():
        net = network().to(device).eval()
        run = partial(net, random_images(net.level, device), net.tables(ring))
        yield Comparison(
            f"{title}: memory",
            {"inference": partial(added_memory, torch.inference_mode()(run), device)},
            "",
            "MB",
        )
    for title, trained, batch in (
        (f"IcoSweepNet {level}/{number // 2}", IcoSweepNet(level, number // 2), 1),
        ("default", pretrained(SHIPPED["default"]), BATCHES[-1]),
    ):
        yield Comparison(
            f"{title}: a training step of {batch}, without the optimiser",
            _steps(trained, ring, batch, device),
        )
    small = ring_rig(4, image_size=(256, 256))
    yield Comparison(
        "four images of 256 x 256 rendered, one ray a pixel",
        {
            str(where): partial(_render, small.to(where))
            for where in dict.fromkeys((torch.device("cpu"), device))
        },
    )


def _parity(rig: CameraRig, images: dict[str, Tensor], device: torch.device) -> dict[str, Run]:
    """How far the index on the device is from the CPU's, in the mean over what is seen."""

    def difference(options: dict[str, Any], precision: Precision) -> float:
        expected = Predictor(rig, min_depth=0.55, **options)(images)
        depth = Predictor(rig, min_depth=0.55, device=device, precision=precision, **options)(images)
        return float((depth.index.cpu() - expected.index)[expected.seen].abs().mean())

    runs: dict[str, Run] = {precision: partial(difference, {}, precision) for precision in PRECISIONS}
    return runs | {
        f"{name}, float32": partial(difference, {"level": int(name[-1])}, "float32")
        for name in list(SHIPPED)[1:]
    }


def _forward(net: DepthNetwork, rig: CameraRig, batch: int, device: torch.device) -> dict[str, Run]:
    """A forward pass through tables that are there: eager, as a CUDA graph, and in less precision."""
    net = net.to(device).eval()
    images, tables = random_images(net.level, device, batch), net.tables(rig)

    @torch.inference_mode()
    def forward(inputs: Tensor) -> Tensor:
        return net(inputs, tables)

    def reduced(precision: torch.dtype) -> Callable[[Tensor], Tensor]:
        return torch.autocast(device.type, precision, cache_enabled=False)(forward)

    passes = {"float32": forward} | {name: reduced(getattr(torch, name)) for name in PRECISIONS[1:]}
    runs: dict[str, Run] = {"eager": partial(forward, images)}
    if device.type == "cuda":
        runs |= {
            f"graph, {name}": partial(GraphedFunction(name, run), images) for name, run in passes.items()
        }
        for run in runs.values():  # captures it
            run()
        return runs
    return runs | {name: partial(run, images) for name, run in passes.items() if name != "float32"}


def _steps(net: DepthNetwork, rig: CameraRig, batch: int, device: torch.device) -> dict[str, Run]:
    """Forward and backward pass, in float32 and in bfloat16."""
    net = net.to(device).train()
    images, tables = random_images(net.level, device, batch), net.tables(rig)

    def step() -> None:
        net(images, tables).sum().backward()
        net.zero_grad()

    return {"float32": step, "bfloat16": torch.autocast(device.type, torch.bfloat16)(step)}


def _answer(predictor: Predictor, images: dict[str, Tensor]) -> Tensor:
    return predictor(images).index.cpu()


def _render(rig: CameraRig) -> Any:
    return render_rig(make_scene("room", seed=1), rig)
