# SPDX-License-Identifier: Apache-2.0
"""One stage in a process of its own: from cold, and with a high-water mark of memory that nothing else has raised."""

from __future__ import annotations

import contextlib
import multiprocessing
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import torch

from sphericalvision.cameras import ring_rig
from sphericalvision.core import kernels
from sphericalvision.icosphere import num_icosphere_vertices
from sphericalvision.models import IcoSweepNet
from sphericalvision.sweep import SphereSweep

__all__ = ["WAYS", "alone"]

WAYS = ("plain", "sphericalvision", "sphericalvision, recompute", "sphericalvision, layers")
"""How a stage can be computed: by the readable formulas; by operators in C++, if there is a compiler, and with less
memory in training; and by layers in torch alone."""


def alone(
    stage: str, way: str, level: int, num_hypotheses: int, device: str = "cpu", **options: int
) -> float:
    """Run one stage in a fresh process.

    Args:
        stage: ``"setup"`` in seconds, without the time to start Python and import torch; ``"inference"`` or
            ``"training"`` in MB of memory that it adds at most.
        way: one of ``WAYS``.
        level: of the images.
        num_hypotheses: N.
        device: torch's name of it.
        options: ``feature_channels``.

    Examples:
        >>> alone("setup", "sphericalvision", level=3, num_hypotheses=4) > 0
        True
    """
    threads = torch.get_num_threads()
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context, torch.set_num_threads, (threads,)) as pool:
        return pool.submit(_run, stage, way, level, num_hypotheses, device, **options).result()


def _run(
    stage: str, way: str, level: int, num_hypotheses: int, device: str, feature_channels: int = 32
) -> float:
    place = torch.device(device)
    chosen = kernels({WAYS[0]: "reference", WAYS[3]: "plain"}.get(way, "auto"))
    rig = ring_rig(4).to(place)
    if stage == "setup":
        start = time.perf_counter()
        with chosen:  # charts are slices of the vertices' order: there is nothing else to make
            SphereSweep(level - 2, num_hypotheses, 0.55).to(place).tables(rig)
        if place.type == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter() - start
    net = IcoSweepNet(level, num_hypotheses, feature_channels=feature_channels).to(place)
    net.configure(recompute=way == WAYS[2])
    images = 2 * torch.rand(1, 4, 3, num_icosphere_vertices(level), device=place) - 1
    tables = net.sweep.tables(rig)
    with chosen:
        if stage == "inference":
            net.eval()
            return _added_memory(torch.inference_mode()(lambda: net(images, tables)), place)
        net.train()
        return _added_memory(lambda: net(images, tables).sum().backward(), place)


def _added_memory(run: Callable[[], Any], device: torch.device) -> float:
    """MB by which the high-water mark rises above what is held before."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        held = torch.cuda.memory_allocated(device)
        run()
        return (torch.cuda.max_memory_allocated(device) - held) / 1e6
    before = _resident("VmRSS")
    # A new mark on Linux; elsewhere, and where that is not allowed, the old one can only hide what is small.
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    run()
    return max(0.0, _resident("VmHWM") - before)


def _resident(field: str) -> float:
    """MB of memory in use (``VmRSS``) or at most so far (``VmHWM``)."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(float(line.split()[1]) for line in lines if line.startswith(field)) * 1024 / 1e6
    except (OSError, StopIteration):
        import resource  # not on Windows

        unit = 1 if sys.platform == "darwin" else 1024
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6
