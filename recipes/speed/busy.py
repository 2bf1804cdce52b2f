# SPDX-License-Identifier: Apache-2.0
"""Frames on a machine that has other work, by how threads are prepared, in processes of their own."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import cache, partial

import numpy as np
import torch
from omegaconf import DictConfig

from sphericalvision.recipes.speed.measuring import Comparison
from sphericalvision.threads import WAITING, available_cores

FRAMES = """
import os, statistics, sys, time
side, cores, prepared = map(int, sys.argv[1:4])
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
times = []
while len(times) < 4 or sum(times) < float(sys.argv[4]):
    began = time.perf_counter()
    predictor(images)
    times.append(time.perf_counter() - began)
print(1000 * times[0], 1000 * statistics.median(times[1:]))
"""
"""A program that computes frames, and prints the milliseconds of its first call and the median of its further ones."""

WAYS = {
    "one thread": ({"OMP_NUM_THREADS": "1"}, True),
    "prepared": ({}, True),
    "as torch comes": ({}, False),
}
"""Way -> variables of the environment, and whether threads and memory are prepared, as the commands do."""
NUM_PROCESSES = 3
"""Processes of each way that times are the median of."""


def busy(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """A frame of a ``Predictor`` on idle cores, next to a busy process for each core, and on one core."""
    del device  # threads are those of a CPU
    side = max(config.image_sides)
    for condition, cores, load in (
        ("no other work", 0, 0),
        ("a busy process for each core", 0, available_cores()),
        ("one core", 1, 0),
    ):
        measured = {
            way: cache(partial(_milliseconds, variables, side, cores, int(prepared), config.seconds))
            for way, (variables, prepared) in WAYS.items()
        }
        with ExitStack() as stack:
            for _ in range(load):
                process = stack.enter_context(subprocess.Popen([sys.executable, "-c", "while True: pass"]))
                stack.callback(process.kill)
            for column, calls in enumerate(("first call", "further calls")):
                runs = {way: partial(_column, times, column) for way, times in measured.items()}
                title = f"{calls}, four images of {side} x {side}, {condition}"
                yield Comparison(title, runs, unit="ms")


def _milliseconds(variables: dict[str, str], *words: float) -> list[float]:
    """Times of the first and of further frames in new processes without settings of threads but ``variables``."""
    environment = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith("OMP_") and name not in WAITING
    }
    command = [sys.executable, "-c", FRAMES, *map(str, words)]
    printed = [
        subprocess.run(command, env=environment | variables, check=True, stdout=subprocess.PIPE).stdout
        for _ in range(NUM_PROCESSES)
    ]
    return [float(value) for value in np.median(np.array([text.split() for text in printed], float), axis=0)]


def _column(times: Callable[[], list[float]], column: int) -> float:
    return times()[column]
