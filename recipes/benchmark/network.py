# SPDX-License-Identifier: Apache-2.0
"""IcoSweepNet stage by stage, against the readable formulas of the same numbers (``reference_kernels``)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from omegaconf import DictConfig
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.core import check_choice, kernels
from sphericalvision.data import ToSphere
from sphericalvision.icosphere import icosphere_vertices, num_icosphere_vertices
from sphericalvision.models import IcoSweepNet
from sphericalvision.recipes.benchmark.alone import WAYS, alone
from sphericalvision.recipes.benchmark.measuring import BF16, Comparison
from sphericalvision.recipes.benchmark.ways import OURS, both_ways, by, count_gbyte, count_gflop
from sphericalvision.sweep import SphereSweep, SweepTables, soft_argmax

__all__ = ["OPTIONS", "comparisons"]

OPTIONS = ("bf16", "compiled", "layers")
"""Other ways to run the network; what they compile shows in the time of the first call."""

Run = Callable[[], Any]


def comparisons(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """All stages at every setting ``[level, N]`` of ``config.settings``."""
    for option in config.options:
        check_choice("options", option, OPTIONS)
    for level, number in config.settings:
        yield from _stages(level, number, config, device)


def _stages(level: int, number: int, config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    torch.manual_seed(0)
    label = f"level {level} to {level - 2}, N = {number}"
    rig = ring_rig(4, image_size=tuple(config.image_size)).to(device)
    net = IcoSweepNet(level, number, feature_channels=config.feature_channels).to(device).eval()
    images = 2 * torch.rand(1, 4, 3, num_icosphere_vertices(level), device=device) - 1
    tables = net.sweep.tables(rig)
    weights = sum(p.numel() * 4 for p in net.parameters())

    yield from _setup(label, level, number, rig, device)
    yield _projection(label, level, rig, device)
    with torch.inference_mode():
        features = net.extract_features(images)
        volume = net.sweep(features, tables).values.flatten(1, 2)
        logits = net.regularizer(volume)
    flop_features = count_gflop(lambda: net.extract_features(images))
    flop_regularizer = count_gflop(lambda: net.regularizer(volume))
    yield Comparison(
        f"{label}: features of four cameras",
        both_ways(lambda: net.extract_features(images)),
        "plain",
        flop_features,
        gbyte=count_gbyte(images, features) + sum(p.numel() * 4 for p in net.features.parameters()) / 1e9,
    )
    yield Comparison(
        f"{label}: cost volume",
        both_ways(lambda: net.sweep(features, tables)),
        "plain",
        2 * 3 * volume.numel() / 1e9,
        gbyte=count_gbyte(features, volume, *tables),
    )
    yield Comparison(
        f"{label}: regulariser",
        both_ways(lambda: net.regularizer(volume)) | _layers(lambda: net.regularizer(volume), config.options),
        "plain",
        flop_regularizer,
        "Operations are those of the plain way. Winograd's ways need three tenths at most: shares may pass 100 %.",
        gbyte=count_gbyte(volume, logits) + sum(p.numel() * 4 for p in net.regularizer.parameters()) / 1e9,
    )
    steps = torch.arange(number, device=device, dtype=logits.dtype).view(1, -1, 1)
    yield Comparison(
        f"{label}: regression",
        {
            "plain": torch.inference_mode()(lambda: (logits.softmax(1) * steps).sum(1)),
            OURS: torch.inference_mode()(lambda: soft_argmax(logits)),
        },
        "plain",
        gbyte=count_gbyte(logits, logits[:, 0]),
    )
    flop, gbyte = flop_features + flop_regularizer, count_gbyte(images, logits[:, 0], *tables) + weights / 1e9
    yield Comparison(
        f"{label}: whole inference",
        both_ways(lambda: net(images, tables)) | _optional(net, images, tables, config.options),
        "plain",
        flop,
        gbyte=gbyte,
    )
    if config.training:
        ways: dict[str, Run] = {
            "plain": lambda: _step(net, images, tables, "reference"),
            OURS: lambda: _step(net, images, tables),
            WAYS[2]: lambda: _step(net, images, tables, recompute=True),
        }
        if "bf16" in config.options:
            ways[OURS + BF16] = lambda: _step(net, images, tables, bf16=True)
        if "layers" in config.options:
            ways[WAYS[3]] = lambda: _step(net, images, tables, "plain")
        yield Comparison(
            f"{label}: one training step, without the optimiser",
            ways,
            "plain",
            3 * flop,
            "Three times the operations of inference, whatever is computed twice.",
            gbyte=3 * gbyte,
        )
    yield from _memory(label, level, number, config, device)


def _setup(label: str, level: int, number: int, rig: CameraRig, device: torch.device) -> Iterator[Comparison]:
    yield Comparison(
        f"{label}: set-up from cold",
        {way: partial(alone, "setup", way, level, number, str(device)) for way in WAYS[:2]},
        "plain",
        unit="reported s",
        rounds=3,
        note="Tables for a new rig in a fresh process, after imports.",
    )
    sweep = SphereSweep(level - 2, number, 0.55).to(device)
    yield Comparison(
        f"{label}: sweep tables of a new rig",
        both_ways(lambda: sweep.tables(rig)),
        "plain",
        gbyte=count_gbyte(*sweep.tables(rig)),
    )


def _projection(label: str, level: int, rig: CameraRig, device: torch.device) -> Comparison:
    """Four fisheye images onto the icosphere, against the interpolation alone at the same places."""
    directions = icosphere_vertices(level).to(device)
    sizes = [camera.image_size for camera in rig.cameras.values()]
    pictures = [torch.rand(3, *size, device=device) for size in sizes]
    scale = torch.tensor(sizes[0][::-1], device=device)
    places = [
        camera.project(directions @ pose[:3, :3]).pixels
        for camera, pose in zip(rig.cameras.values(), rig.world_from_camera, strict=True)
    ]
    grids = torch.stack([((2 * pixels + 1) / scale - 1)[None] for pixels in places])
    stack = torch.stack(pictures)
    to_sphere, named = ToSphere(level), dict(zip(rig.names, pictures, strict=True))
    return Comparison(
        f"{label}: projection of four fisheye images",
        {
            "bare grid_sample": lambda: F.grid_sample(stack, grids, align_corners=False),
            "ToSphere, the rig seen before": lambda: to_sphere.images(named, rig),
            "rig.sample_sphere, any rig": lambda: rig.sample_sphere(pictures, directions),
        },
        "bare grid_sample",
        gbyte=count_gbyte(stack, grids) + 4 * 3 * 4 * len(directions) / 1e9,
    )


def _memory(
    label: str, level: int, number: int, config: DictConfig, device: torch.device
) -> Iterator[Comparison]:
    if not config.memory:
        return
    layers = WAYS[3:] if "layers" in config.options else ()
    for stage, ways in (("inference", WAYS[:2] + layers), ("training", WAYS[:3] + layers)):
        if stage == "inference" or config.training:
            options = {"device": str(device), "feature_channels": config.feature_channels}
            yield Comparison(
                f"{label}: memory that {stage} adds",
                {way: partial(alone, stage, way, level, number, **options) for way in ways},
                "plain",
                unit="MB",
                note="The highest mark above what network, images and tables hold, in a fresh process.",
            )


def _optional(net: IcoSweepNet, images: Tensor, tables: SweepTables, options: list[str]) -> dict[str, Run]:
    """The whole network in ways that are not the default."""

    def bf16(run: Run) -> Run:
        def cast() -> Any:
            with torch.autocast(images.device.type, torch.bfloat16):
                return run()

        return torch.inference_mode()(cast)

    runs = _layers(lambda: net(images, tables), options)
    if "bf16" in options:
        runs[OURS + BF16] = bf16(lambda: net(images, tables))
    if "compiled" in options:
        compiled = torch.compile(net)
        runs[f"{OURS}, compiled"] = torch.no_grad()(lambda: compiled(images, tables))
        if "bf16" in options:
            runs[f"{OURS}, compiled{BF16}"] = torch.no_grad()(bf16(lambda: compiled(images, tables)))
    return runs


def _layers(run: Run, options: list[str]) -> dict[str, Run]:
    """What a network does by layers in torch alone, if that is among the options."""
    return {WAYS[3]: torch.inference_mode()(by("plain", run))} if "layers" in options else {}


def _step(
    net: IcoSweepNet,
    images: Tensor,
    tables: Any,
    way: str = "auto",
    recompute: bool = False,
    bf16: bool = False,
) -> None:
    """Forward and backward pass in training mode."""
    net.train()
    net.configure(recompute=recompute)
    with kernels(way):
        with torch.autocast(images.device.type, torch.bfloat16, enabled=bf16):
            index = net(images, tables)
        index.sum().backward()
    net.zero_grad()
    net.configure(recompute=False)
    net.eval()
