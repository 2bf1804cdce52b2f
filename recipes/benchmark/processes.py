# SPDX-License-Identifier: Apache-2.0
"""What two cores are better used for in training: two processes of one thread, or one process of two threads."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import torch
from omegaconf import DictConfig

from sphericalvision.recipes.benchmark.measuring import Comparison
from sphericalvision.recipes.benchmark.training import HYPOTHESES, LEVEL, NETWORK, training_step

__all__ = ["comparisons", "seconds_per_sample"]


def comparisons(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """Seconds a sample, of all processes together, without their start."""
    ways = {"one process, two threads": (1, 2), "two processes, one thread each": (2, 1)}
    yield Comparison(
        f"level {LEVEL} to {LEVEL - 2}, N = {HYPOTHESES}: training {NETWORK}, seconds a sample",
        {
            name: partial(seconds_per_sample, processes, threads, config.seconds)
            for name, (processes, threads) in ways.items()
        },
        "one process, two threads",
        unit="reported s",
        rounds=3,
        note="Steps without the optimiser, of batches of one; by the clock on the wall, so the machine must be idle.",
    )


def seconds_per_sample(processes: int, threads: int, seconds: float) -> float:
    """Train in fresh processes side by side and return the seconds that one sample takes all of them together.

    Args:
        processes: how many, which start to count when all are ready.
        threads: of each.
        seconds: how long they train.

    Examples:
        >>> seconds_per_sample(processes=1, threads=1, seconds=0.1) > 0
        True
    """
    context = multiprocessing.get_context("spawn")
    ready, rates = context.Barrier(processes), context.SimpleQueue()
    running = [
        context.Process(target=_train, args=(threads, seconds, ready, rates)) for _ in range(processes)
    ]
    for process in running:
        process.start()
    for process in running:
        process.join()
    if any(process.exitcode for process in running):
        raise RuntimeError("a process that trains ended with an error, which stands above")
    return 1 / sum(rates.get() for _ in running)


def _train(threads: int, seconds: float, ready: Any, rates: Any) -> None:
    """Wait until all processes are ready, and tell how many samples a second were learnt from."""
    torch.set_num_threads(threads)
    step = training_step()
    for _ in range(2):
        step()
    ready.wait()
    start, steps = time.perf_counter(), 0
    while not steps or time.perf_counter() - start < seconds:
        step()
        steps += 1
    rates.put(steps / (time.perf_counter() - start))
