# SPDX-License-Identifier: Apache-2.0
"""Networks against the readable formulas of the same numbers, and with each other; convolutions against planar ones."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from importlib.resources import files
from typing import Any

import torch
import torch.nn.functional as F
from omegaconf import DictConfig, OmegaConf
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils.flop_counter import FlopCounterMode

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.core import check_choice
from sphericalvision.crown import Crown, CrownConv2d, CrownConv3d, HexConv2d, HexConv3d, to_crown
from sphericalvision.data import ToSphere
from sphericalvision.icosphere import icosphere_vertices, num_icosphere_vertices
from sphericalvision.kernels import kernels, reference_kernels
from sphericalvision.models import DepthNetwork, IcoSweepNet, SemiGlobalSweep
from sphericalvision.recipes.app.cli import build
from sphericalvision.recipes.speed.measuring import (
    OURS,
    Comparison,
    Run,
    added_memory,
    random_images,
    ways,
)
from sphericalvision.sweep import SphereSweep
from sphericalvision.sweep.correlation import correlation_evidence

__all__ = ["convolutions", "gflop", "network", "sweep", "training", "variant", "variants"]

FRAME = 6, 16
"""Level of the images and N of what is measured at one setting alone."""


def network(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """All stages of the paper's network, and memory, at every setting ``[level, N]`` of ``config.settings``."""
    for level, number in config.settings:
        torch.manual_seed(0)
        rig = ring_rig(4, image_size=tuple(config.image_size)).to(device)
        net = IcoSweepNet(level, number, feature_channels=config.feature_channels).to(device).eval()
        label = f"level {level} to {level - 2}, N = {number}"
        images, tables = random_images(level, device), net.sweep.tables(rig)
        with torch.inference_mode():
            features = net.extract_features(images)
            volume = net.sweep(features, tables).values.flatten(1, 2)
        stages: dict[str, Run] = {
            "sweep tables of a new rig": partial(net.sweep.tables, rig),
            "features of four cameras": partial(net.extract_features, images),
            "cost volume": partial(net.sweep, features, tables),
            "regulariser": partial(net.regularizer, volume),
            "whole inference": partial(net, images, tables),
        }
        runs = {stage: ways(run, config.options, device) for stage, run in stages.items()}
        steps = _steps(net, images, tables, config.options, device)
        for title, own in (runs | {"one training step, without the optimiser": steps}).items():
            yield Comparison(f"{label}: {title}", own)
        for title, own in {"inference": runs["whole inference"], "training": steps}.items():
            yield Comparison(
                f"{label}: memory that {title} adds",
                {name: partial(added_memory, run, device) for name, run in own.items()},
                "The highest mark above what network, images and tables hold.",
                "MB",
            )
        yield _projection(level, rig, device)


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
    poses = zip(rig.cameras.values(), rig.world_from_camera, strict=True)
    pixels = torch.stack([camera.project(directions @ pose[:3, :3]).pixels for camera, pose in poses])
    grids = ((2 * pixels + 1) / torch.tensor([width, height], device=device) - 1)[:, None]
    runs = {
        "bare grid_sample": partial(
            F.grid_sample, torch.stack([*images.values()]), grids, align_corners=False
        ),
        "ToSphere, the rig seen before": partial(ToSphere(level).images, images, rig),
    }
    return Comparison(f"level {level}: projection of four fisheye images", runs)


def training(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """A training step of the small network."""
    torch.manual_seed(0)
    level, number = FRAME
    net = variant("icosweepnet_small", level, number).to(device)
    tables = net.tables(ring_rig(4).to(device))
    steps = _steps(net, random_images(level, device), tables, config.options, device)
    yield Comparison(f"level {level}, N = {number}: a training step of icosweepnet_small", steps)


def sweep(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """Depth without training, and the correlations that networks may start from."""
    level, number = FRAME
    rig, images = ring_rig(4).to(device), random_images(level, device)
    net = SemiGlobalSweep(level, number).to(device)
    evidence = SphereSweep(level - 2, number, 0.55, level).to(device).tables(rig)
    for title, run in {
        "semi-global sweep": partial(net, images, net.tables(rig)),
        "correlation evidence": partial(correlation_evidence, images, evidence),
    }.items():
        runs = ways(run, config.options, device)
        yield Comparison(f"level {level} to {level - 2}, N = {number}: {title}", runs)


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
            size = sum(parameter.numel() for parameter in net.parameters())
            notes.append(f"{name}: {size:,} parameters, {gflop(net):.4g} GFLOP")
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
    texts = {
        file.name.removesuffix(".yaml"): file.read_text()
        for file in (files("sphericalvision.conf") / "model").iterdir()
        if file.name.endswith(".yaml")
    }
    check_choice(
        "variants", name, tuple(sorted(key for key, text in texts.items() if "\naggregation:" in text))
    )
    node = {**OmegaConf.create(texts[name]), "level": level, "num_hypotheses": num_hypotheses}
    net: IcoSweepNet = build(node, "variants")
    return net.eval()


def gflop(net: IcoSweepNet) -> float:
    """1e9 operations of convolutions and matrix products of a frame, done directly; counted on shapes alone."""
    tables, images = net.sweep.tables(ring_rig(4)), random_images(net.level, torch.device("cpu"))
    fresh, counter = IcoSweepNet(**net.hyperparameters).eval(), FlopCounterMode(display=False)
    with torch.no_grad(), reference_kernels(), FakeTensorMode(allow_non_fake_inputs=True), counter:
        fresh(images, tables)
    return float(counter.get_total_flops()) / 1e9


def convolutions(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """Forward and backward pass at every ``[level, channels]`` of ``convolution_settings``, against as many pixels.

    2D, and 3D of 16 hypotheses two levels coarser. There it is two volumes: for a single small one torch takes a
    convolution on the CPU that is several times slower.
    """
    kinds = (nn.Conv2d, HexConv2d, CrownConv2d), (nn.Conv3d, HexConv3d, CrownConv3d)
    names = "planar", "hex along charts", "crown, both directions"
    for level, channels in config.convolution_settings:
        for own, batch, depth, classes in ((level, 1, (), kinds[0]), (level - 2, 2, (16,), kinds[1])):
            if own < 0:
                continue
            vertices, rows = num_icosphere_vertices(own), 2 ** (own + 1)
            values = torch.randn(batch, channels, *depth, vertices, device=device)
            # as many pixels as there are vertices but the poles
            image = torch.randn(batch, channels, *depth, rows, 5 * rows // 2, device=device)
            layers = [
                classes[0](channels, channels, 3, padding=1, bias=False),
                *(kind(channels, channels) for kind in classes[1:]),
            ]
            runs: dict[str, Run] = {}
            inputs: list[Tensor | Crown] = [image, values, to_crown(values)]
            for name, layer, values_in in zip(names, layers, inputs, strict=True):
                runs[name] = _forward_and_backward(layer.to(device), values_in)
                if name != "planar" and "layers" in config.options:
                    runs[f"{name}, layers"] = kernels("plain")(runs[name])
            hypotheses = "".join(f", {number} hypotheses" for number in depth)
            title = f"{batch} x {vertices} samples{hypotheses}, {channels} channels"
            yield Comparison(f"convolution, forward and backward: {title}", runs)


def _forward_and_backward(layer: nn.Module, values: Tensor | Crown) -> Run:
    """Apply a layer and derive by its input and its parameters."""
    tensors = values if isinstance(values, Crown) else (values,)
    inputs = [tensor.detach().requires_grad_() for tensor in tensors]
    argument = Crown(*inputs) if isinstance(values, Crown) else inputs[0]

    def outputs() -> list[Tensor]:
        result = layer(argument)
        return list(result) if isinstance(result, Crown) else [result]

    weights = [torch.randn_like(output) for output in outputs()]
    return lambda: torch.autograd.grad(outputs(), [*inputs, *layer.parameters()], weights)
