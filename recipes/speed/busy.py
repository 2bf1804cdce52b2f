# SPDX-License-Identifier: Apache-2.0
"""Frames on a machine that has other work: by how threads are prepared, in processes that compute in turns."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import partial

import torch
from omegaconf import DictConfig

from sphericalvision.recipes.speed.measuring import Comparison, Seconds
from sphericalvision.threads import WAITING, available_cores

FRAMES = """
import os, sys, time
side, cores, prepared = map(int, sys.argv[1:])
if cores:
    os.sched_setaffinity(0, [*os.sched_getaffinity(0)][:cores])
if prepared:
    from sphericalvision.threads import prepare_threads
    prepare_threads()
import torch
from sphericalvision.cameras import ring_rig
from sphericalvision.capture import Predictor
images = torch.nn.functional.interpolate(torch.rand(4, 3, 50, 50), (side, side), mode="bilinear").unbind()
rig = ring_rig(4, image_size=(side, side))
predictor, images = Predictor(rig, min_depth=0.55), dict(zip(rig.names, images))
for line in sys.stdin:
    wall, cpu = time.perf_counter(), time.process_time()
    predictor(images)
    print(time.perf_counter() - wall, time.process_time() - cpu, flush=True)
"""
"""A program that computes a frame for each line that it reads, and prints its seconds on the clock and of the CPU."""

WAYS = {
    "one thread": ({"OMP_NUM_THREADS": "1"}, True),
    "prepared": ({}, True),
    "as torch comes": ({}, False),
}
"""Way -> variables of the environment, and whether threads and memory are prepared, as the commands do."""
FIRST_CALLS = 3
"""Processes of each way that the time of a first call is the median of."""


def busy(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """A frame of a ``Predictor`` on idle cores, next to a busy process for each core, and on one core."""
    del device  # threads are those of a CPU
    side = max(config.image_sides)
    for condition, cores, load in (
        ("no other work", 0, 0),
        ("a busy process for each core", 0, available_cores()),
        ("one core", 1, 0),
    ):
        title = f"four images of {side} x {side}, {condition}"
        starts = {
            way: partial(_process, variables, FRAMES, side, cores, int(prepared))
            for way, (variables, prepared) in WAYS.items()
        }
        with ExitStack() as stack:
            for _ in range(load):
                stack.enter_context(_process({}, "while True: pass"))
            firsts = {way: partial(_first_frame, start) for way, start in starts.items()}
            yield Comparison(f"first call, {title}", firsts, unit="ms")
            processes = {way: stack.enter_context(start()) for way, start in starts.items()}
            further = {way: partial(_frame, process) for way, process in processes.items()}
            yield Comparison(f"further calls, {title}", further)


@contextmanager
def _process(variables: dict[str, str], program: str, *words: int) -> Iterator[subprocess.Popen[str]]:
    """A process of Python without settings of threads but ``variables``; ends with the block."""
    environment = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith("OMP_") and name not in WAITING
    }
    with subprocess.Popen(
        [sys.executable, "-c", program, *map(str, words)],
        env=environment | variables,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def _frame(process: subprocess.Popen[str]) -> Seconds:
    """Let another process compute a frame, and time itself."""
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write("\n")
    process.stdin.flush()
    return Seconds(*map(float, process.stdout.readline().split()))


def _first_frame(start: Callable[[], AbstractContextManager[subprocess.Popen[str]]]) -> float:
    """Milliseconds of the first frame, the median of some processes."""
    times = []
    for _ in range(FIRST_CALLS):
        with start() as process:
            times.append(1000 * _frame(process).wall)
    return statistics.median(times)
