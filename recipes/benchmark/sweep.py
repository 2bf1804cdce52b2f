# SPDX-License-Identifier: Apache-2.0
"""Depth without training, and the evidence that networks may start from: CPU time of a frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from omegaconf import DictConfig

from sphericalvision.cameras import ring_rig
from sphericalvision.icosphere import num_icosphere_vertices
from sphericalvision.models import SemiGlobalSweep
from sphericalvision.recipes.benchmark.measuring import Comparison
from sphericalvision.recipes.benchmark.ways import both_ways, cpu_seconds
from sphericalvision.sweep import SphereSweep
from sphericalvision.sweep.correlation import correlation_evidence

__all__ = ["comparisons"]

LEVEL, HYPOTHESES = 6, 16
"""Of the images; the semi-global sweep compares cameras one level coarser, and its depth is two levels coarser."""


def comparisons(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """The semi-global sweep with costs on level 5, and correlations on level 4, of four cameras."""
    torch.manual_seed(0)
    rig = ring_rig(4).to(device)
    images = 2 * torch.rand(1, 4, 3, num_icosphere_vertices(LEVEL), device=device) - 1
    net = SemiGlobalSweep(LEVEL, HYPOTHESES).to(device)
    net_tables = net.tables(rig)
    yield _by_both_ways(
        f"level {LEVEL} to {LEVEL - 2}, N = {HYPOTHESES}: semi-global sweep, CPU time of a frame",
        lambda: net(images, net_tables),
    )
    tables = SphereSweep(4, HYPOTHESES, 0.55, LEVEL).to(device).tables(rig)
    yield _by_both_ways(
        f"level {LEVEL} to 4, N = {HYPOTHESES}: correlation evidence, CPU time of a frame",
        lambda: correlation_evidence(images, tables),
    )


def _by_both_ways(title: str, run: Callable[[], Any]) -> Comparison:
    runs = {name: cpu_seconds(way) for name, way in both_ways(run).items()}
    return Comparison(title, runs, "plain", unit="reported s", rounds=5)
