# SPDX-License-Identifier: Apache-2.0
"""A training step of the network that ships, forward and backward: CPU time, which other processes do not change."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from omegaconf import DictConfig

from sphericalvision.cameras import ring_rig
from sphericalvision.icosphere import num_icosphere_vertices
from sphericalvision.recipes.benchmark.measuring import Comparison
from sphericalvision.recipes.benchmark.variants import variant
from sphericalvision.recipes.benchmark.ways import OURS, cpu_seconds, plainly

__all__ = ["comparisons", "training_step"]

NETWORK, LEVEL, HYPOTHESES = "icosweepnet_small", 6, 16


def comparisons(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """Layer by layer by the readable formulas, by the fast ways in PyTorch, and by operators in C++."""
    runs = {"plain": plainly(training_step()), OURS: training_step()}
    if "native" in config.options:
        runs[f"{OURS}, native"] = training_step(native=True)
    yield Comparison(
        f"level {LEVEL} to {LEVEL - 2}, N = {HYPOTHESES}: a training step of {NETWORK}, CPU time",
        {name: cpu_seconds(run) for name, run in runs.items()},
        "plain",
        unit="reported s",
        rounds=5,
    )


def training_step(native: bool = False) -> Callable[[], None]:
    """One step without the optimiser, as a function."""
    torch.manual_seed(0)
    net = variant(NETWORK, LEVEL, HYPOTHESES).train().configure(native=native)
    tables = net.tables(ring_rig(4))
    images = 2 * torch.rand(1, 4, 3, num_icosphere_vertices(LEVEL)) - 1

    def step() -> None:
        net(images, tables).sum().backward()
        net.zero_grad()

    return step
