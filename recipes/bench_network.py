# SPDX-License-Identifier: Apache-2.0
"""IcoSweepNet stage by stage, against the plain way to compute the same numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
import torch.nn.functional as F
from omegaconf import DictConfig
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from sphericalvision.cameras import ring_rig
from sphericalvision.data import ToSphere
from sphericalvision.icosphere import icosphere_vertices, num_icosphere_vertices
from sphericalvision.models import IcoSweepNet
from sphericalvision.recipes.benchmarking import Comparison
from sphericalvision.recipes.plain_network import PlainNetwork
from sphericalvision.sweep import SphereSweep, soft_argmax

__all__ = ["comparisons"]


def comparisons(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """All stages at every setting ``[level, N]`` of ``config.settings``."""
    for level, number in config.settings:
        yield from _stages(level, number, config, device)


def _stages(level: int, number: int, config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    torch.manual_seed(0)
    label = f"level {level} to {level - 2}, N = {number}"
    rig = ring_rig(4, image_size=tuple(config.image_size)).to(device)
    net = IcoSweepNet(level, number, feature_channels=config.feature_channels).to(device).eval()
    plain = PlainNetwork(net).to(device).eval()
    images = 2 * torch.rand(1, 4, 3, num_icosphere_vertices(level), device=device) - 1
    tables = net.sweep.tables(rig)

    def inference(run: Callable[[], Any]) -> Callable[[], Any]:
        return torch.inference_mode()(run)

    yield Comparison(
        f"{label}: sweep tables of a new rig",
        {"sweep tables": inference(lambda: SphereSweep(level - 2, number, 0.55).to(device).tables(rig))},
        "sweep tables",
    )
    yield _projection(label, level, rig, device)
    with torch.inference_mode():
        features = net.extract_features(images)
        volume = net.sweep(features, tables).values.flatten(1, 2)
        logits = net.regularizer(volume)
    yield Comparison(
        f"{label}: features of four cameras",
        {
            "plain": inference(lambda: [plain.features(camera) for camera in images.unbind(1)]),
            "sphericalvision": inference(lambda: net.extract_features(images)),
        },
        "plain",
        _gflop(lambda: [plain.features(camera) for camera in images.unbind(1)]),
    )
    yield Comparison(
        f"{label}: cost volume",
        {
            "plain": inference(lambda: plain.volume(features, tables)),
            "sphericalvision": inference(lambda: net.sweep(features, tables)),
        },
        "plain",
    )
    yield Comparison(
        f"{label}: regulariser",
        {
            "plain": inference(lambda: plain.regularize(volume)),
            "sphericalvision": inference(lambda: net.regularizer(volume)),
        },
        "plain",
        _gflop(lambda: plain.regularize(volume)),
        note="GFLOP/s count what the plain way computes; Winograd's way needs half of it.",
    )
    yield Comparison(
        f"{label}: regression", {"soft-argmax": inference(lambda: soft_argmax(logits))}, "soft-argmax"
    )
    yield Comparison(
        f"{label}: whole inference",
        {
            "plain": inference(lambda: plain(images, tables)),
            "sphericalvision": inference(lambda: net(images, tables)),
        },
        "plain",
        _gflop(lambda: plain(images, tables)),
    )
    if config.training:
        yield Comparison(
            f"{label}: one training step, without the optimiser",
            {
                "plain": lambda: _step(plain, images, tables),
                "sphericalvision": lambda: _step(net, images, tables),
                "sphericalvision, recompute": lambda: _step(net, images, tables, recompute=True),
            },
            "plain",
        )


def _projection(label: str, level: int, rig: Any, device: torch.device) -> Comparison:
    """Four fisheye images onto the icosphere, against the interpolation alone."""
    directions = icosphere_vertices(level).to(device)
    pictures = [torch.rand(3, *camera.image_size, device=device) for camera in rig.cameras.values()]
    grids = 2 * torch.rand(4, 1, len(directions), 2, device=device) - 1
    stack = torch.stack(pictures)
    to_sphere, named = ToSphere(level), dict(zip(rig.names, pictures, strict=True))
    return Comparison(
        f"{label}: projection of four fisheye images",
        {
            "bare grid_sample": lambda: F.grid_sample(stack, grids, align_corners=True),
            "ToSphere, the rig seen before": lambda: to_sphere.images(named, rig),
            "rig.sample_sphere, any rig": lambda: rig.sample_sphere(pictures, directions),
        },
        "bare grid_sample",
    )


def _step(net: IcoSweepNet | PlainNetwork, images: Tensor, tables: Any, recompute: bool = False) -> None:
    """Forward and backward pass in training mode."""
    net.train()
    if isinstance(net, IcoSweepNet):
        net.recompute = recompute
    net(images, tables).sum().backward()
    net.zero_grad()
    net.eval()


@torch.inference_mode()
def _gflop(run: Callable[[], Any]) -> float:
    """Floating-point operations of convolutions and matrix products, in 1e9."""
    with FlopCounterMode(display=False) as counter:
        run()
    return float(counter.get_total_flops()) / 1e9
