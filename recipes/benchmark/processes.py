# SPDX-License-Identifier: Apache-2.0
"""What two cores are better used for in training: two processes of one thread, or one process of two threads."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial

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
    command = [sys.executable, "-m", __name__, str(threads), str(seconds)]
    running = [
        subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"OMP_NUM_THREADS": str(threads)},
        )
        for _ in range(processes)
    ]
    for process in running:
        assert process.stdout is not None
        process.stdout.readline()  # it is ready
    for process in running:
        assert process.stdin is not None
        process.stdin.write("go\n")
        process.stdin.flush()
    answers = [process.communicate()[0] for process in running]
    if any(process.returncode for process in running):
        raise RuntimeError("a process that trains ended with an error, which stands above")
    return 1 / sum(float(answer.split()[-1]) for answer in answers)


def _train(threads: int, seconds: float) -> None:
    """Say that all is ready, wait for a line, and print how many samples a second were learnt from."""
    torch.set_num_threads(threads)
    step = training_step()
    for _ in range(2):
        step()
    print("ready", flush=True)
    sys.stdin.readline()
    start, steps = time.perf_counter(), 0
    while not steps or time.perf_counter() - start < seconds:
        step()
        steps += 1
    print(steps / (time.perf_counter() - start))


if __name__ == "__main__":
    _train(int(sys.argv[1]), float(sys.argv[2]))
