# SPDX-License-Identifier: Apache-2.0
"""Networks against the readable formulas of the same numbers: stage by stage, in training, and with each other."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from importlib.resources import files
from typing import Any

import torch
import torch.nn.functional as F
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.core import ArgumentError
from sphericalvision.data import ToSphere
from sphericalvision.icosphere import icosphere_vertices
from sphericalvision.models import DepthNetwork, IcoSweepNet, SemiGlobalSweep
from sphericalvision.recipes.app.cli import build
from sphericalvision.recipes.speed.measuring import (
    OURS,
    Comparison,
    Run,
    added_memory,
    count_gflop,
    random_images,
    ways,
)
from sphericalvision.sweep import SphereSweep
from sphericalvision.sweep.correlation import correlation_evidence

__all__ = ["gflop", "network", "sweep", "training", "variant", "variants"]

FRAME = 6, 16
"""Level of the images and N of what is measured at one setting alone."""


def network(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """All stages of the paper's network, and memory, at every setting ``[level, N]`` of ``config.settings``."""
    for level, number in config.settings:
        torch.manual_seed(0)
        rig = ring_rig(4, image_size=tuple(config.image_size)).to(device)
        net = IcoSweepNet(level, number, feature_channels=config.feature_channels).to(device).eval()
        yield from _stages(net, rig, config, device)
        yield _projection(level, rig, device)


def _stages(
    net: IcoSweepNet, rig: CameraRig, config: DictConfig, device: torch.device
) -> Iterator[Comparison]:
    label = f"level {net.level} to {net.level - 2}, N = {net.num_hypotheses}"
    images, tables = random_images(net.level, device), net.sweep.tables(rig)
    with torch.inference_mode():
        features = net.extract_features(images)
        volume = net.sweep(features, tables).values.flatten(1, 2)
    for stage, run in {
        "sweep tables of a new rig": lambda: net.sweep.tables(rig),
        "features of four cameras": lambda: net.extract_features(images),
        "cost volume": lambda: net.sweep(features, tables),
        "regulariser": lambda: net.regularizer(volume),
        "whole inference": lambda: net(images, tables),
    }.items():
        yield Comparison(f"{label}: {stage}", ways(run, config.options, device))
    inference = ways(lambda: net(images, tables), config.options, device)
    steps = _steps(net, images, tables, config.options, device)
    if config.training:
        yield Comparison(f"{label}: one training step, without the optimiser", steps)
    for stage, runs in {"inference": inference, **({"training": steps} if config.training else {})}.items():
        if config.memory:
            yield Comparison(
                f"{label}: memory that {stage} adds",
                {name: partial(added_memory, run, device) for name, run in runs.items()},
                "The highest mark above what network, images and tables hold.",
                "MB",
            )


def _steps(
    net: DepthNetwork, images: Tensor, tables: Any, options: list[str], device: torch.device
) -> dict[str, Run]:
    """Forward and backward pass in training mode, by the ways of inference and with ``recompute``."""

    def step(recompute: bool = False) -> None:
        net.train().configure(recompute=recompute)
        net(images, tables).sum().backward()
        net.eval().configure(recompute=False)
        net.zero_grad()

    return ways(step, options, device, inference=False) | {
        f"{OURS}, recompute": partial(step, recompute=True)
    }


def _projection(level: int, rig: CameraRig, device: torch.device) -> Comparison:
    """Four fisheye images onto the icosphere, against the interpolation alone at the same places."""
    directions = icosphere_vertices(level).to(device)
    height, width = next(iter(rig.cameras.values())).image_size
    images = {name: torch.rand(3, height, width, device=device) for name in rig.names}
    pixels = torch.stack(
        [
            camera.project(directions @ pose[:3, :3]).pixels
            for camera, pose in zip(rig.cameras.values(), rig.world_from_camera, strict=True)
        ]
    )
    grids = ((2 * pixels + 1) / torch.tensor([width, height], device=device) - 1)[:, None]
    stack, to_sphere = torch.stack([*images.values()]), ToSphere(level)
    runs = {
        "bare grid_sample": lambda: F.grid_sample(stack, grids, align_corners=False),
        "ToSphere, the rig seen before": lambda: to_sphere.images(images, rig),
    }
    return Comparison(f"level {level}: projection of four fisheye images", runs)


def training(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """A training step of the small network."""
    torch.manual_seed(0)
    net = variant("icosweepnet_small", *FRAME).to(device)
    steps = _steps(
        net, random_images(net.level, device), net.tables(ring_rig(4).to(device)), config.options, device
    )
    yield Comparison(f"level {FRAME[0]}, N = {FRAME[1]}: a training step of icosweepnet_small", steps)


def sweep(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """Depth without training, and the correlations that networks may start from."""
    level, number = FRAME
    rig, images = ring_rig(4).to(device), random_images(level, device)
    net = SemiGlobalSweep(level, number).to(device)
    tables, evidence = net.tables(rig), SphereSweep(level - 2, number, 0.55, level).to(device).tables(rig)
    for title, run in {
        "semi-global sweep": lambda: net(images, tables),
        "correlation evidence": lambda: correlation_evidence(images, evidence),
    }.items():
        yield Comparison(
            f"level {level} to {level - 2}, N = {number}: {title}", ways(run, config.options, device)
        )


def variants(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """Whole inference of the networks ``config.variants`` of conf/model at every setting of ``config.settings``."""
    for level, number in config.settings:
        rig, images = ring_rig(4).to(device), random_images(level, device)
        runs: dict[str, Run] = {}
        notes = []
        for name in config.variants:
            net = variant(name, level, number).to(device)
            usual = ways(partial(net, images, net.tables(rig)), config.options, device)
            runs |= {way.replace(OURS, name): run for way, run in usual.items() if way != "plain"}
            number_of = sum(parameter.numel() for parameter in net.parameters())
            notes.append(f"{name}: {number_of:,} parameters, {gflop(net):.4g} GFLOP")
        yield Comparison(
            f"level {level} to {level - 2}, N = {number}: networks", runs, "; ".join(notes) + "."
        )


def variant(name: str, level: int, num_hypotheses: int) -> IcoSweepNet:
    """The network of ``conf/model/<name>.yaml``, for inference, at a level and a number of hypotheses.

    Raises:
        ArgumentError: there is no such file, or it describes another kind of network.

    Examples:
        >>> sum(parameter.numel() for parameter in variant("icosweepnet_rt", 4, 8).parameters())
        82413
    """
    folder = files("sphericalvision.conf") / "model"
    path = folder / f"{name}.yaml"
    if not path.is_file():
        names = sorted(
            entry.name.removesuffix(".yaml") for entry in folder.iterdir() if "icosweep" in entry.name
        )
        raise ArgumentError(
            f"variants: expected names of conf/model, such as {', '.join(names)}, got {name!r}"
        )
    node = OmegaConf.create(path.read_text())
    if "aggregation" not in node:
        raise ArgumentError(f"variants: conf/model/{name}.yaml is no IcoSweepNet")
    net: IcoSweepNet = build({**node, "level": level, "num_hypotheses": num_hypotheses}, "variants")
    return net.eval()


def gflop(net: IcoSweepNet) -> float:
    """1e9 floating-point operations of a frame, done directly; nothing is computed."""
    tables, images = net.sweep.tables(ring_rig(4)), random_images(net.level, torch.device("cpu"))
    fresh = IcoSweepNet(**net.hyperparameters).eval()
    return count_gflop(lambda: fresh(images, tables))
