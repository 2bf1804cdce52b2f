# SPDX-License-Identifier: Apache-2.0
"""Frames on a machine that has other work: by how threads are prepared, in processes that compute in turns."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial

import torch
from omegaconf import DictConfig

from sphericalvision.recipes.speed.measuring import Comparison
from sphericalvision.threads import WAITING, available_cores

FRAMES = """
import sys
side, prepared = int(sys.argv[1]), sys.argv[2] == "True"
if prepared:
    from sphericalvision.threads import prepare_threads
    prepare_threads()
import torch
from sphericalvision.cameras import ring_rig
from sphericalvision.capture import Predictor
images = torch.nn.functional.interpolate(torch.rand(4, 3, 50, 50), (side, side), mode="bilinear").unbind()
rig = ring_rig(4, image_size=(side, side))
predictor, images = Predictor(rig, min_depth=0.55), dict(zip(rig.names, images))
print("ready", flush=True)
for line in sys.stdin:
    predictor(images)
    print("done", flush=True)
"""
"""A program that computes a frame for each line that it reads."""

WAYS = {
    "one thread": ({"OMP_NUM_THREADS": "1"}, False),
    "prepared": ({}, True),
    "as torch comes": ({}, False),
}
"""Way -> variables of the environment, and whether threads are prepared, as the commands do."""
FIRST_CALLS = 3
"""Processes of each way; the last computes the further calls."""


def busy(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """A frame of a ``Predictor`` on idle cores, next to a busy process for each core, and on one core."""
    del device  # threads are those of a CPU
    side = max(config.image_sides)
    for condition, cores, load in (
        ("no other work", None, 0),
        ("a busy process for each core", None, available_cores()),
        ("one core", 1, 0),
    ):
        with ExitStack() as stack:
            for _ in range(load):
                stack.enter_context(_process(["-c", "while True: pass"], {}, None))
            first_calls: dict[str, list[float]] = {way: [] for way in WAYS}
            processes = {}
            for call in range(FIRST_CALLS):
                for way, (variables, prepared) in WAYS.items():
                    with ExitStack() as own:
                        arguments = ["-c", FRAMES, str(side), str(prepared)]
                        process = own.enter_context(_process(arguments, variables, cores))
                        assert process.stdout is not None
                        process.stdout.readline()  # torch and the network are loaded
                        first_calls[way].append(_frame(process))
                        if call == FIRST_CALLS - 1:
                            processes[way] = process
                            stack.push(own.pop_all())
            title = f"four images of {side} x {side}, {condition}"
            firsts = {way: partial(statistics.median, calls) for way, calls in first_calls.items()}
            yield Comparison(f"first call, {title}", firsts, unit="ms")
            yield Comparison(
                f"further calls, {title}",
                {way: partial(_frame, process) for way, process in processes.items()},
            )


@contextmanager
def _process(
    words: list[str], variables: dict[str, str], cores: int | None
) -> Iterator[subprocess.Popen[str]]:
    """A process of Python on some of the cores, without settings of threads but ``variables``; ends with the block."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("OMP_")}
    for name in WAITING:
        environment.pop(name, None)
    process = subprocess.Popen(
        [sys.executable, *words],
        env=environment | variables,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=None
        if cores is None
        else lambda: os.sched_setaffinity(0, [*os.sched_getaffinity(0)][:cores]),
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def _frame(process: subprocess.Popen[str]) -> float:
    """Milliseconds of a frame in another process."""
    assert process.stdin is not None
    assert process.stdout is not None
    start = time.perf_counter()
    process.stdin.write("\n")
    process.stdin.flush()
    if process.stdout.readline() != "done\n":
        raise RuntimeError("the process that computes frames has ended")
    return 1000 * (time.perf_counter() - start)
