# SPDX-License-Identifier: Apache-2.0
"""Measuring fairly: what is compared runs in turns, in one process, so that a busy machine slows all alike."""

from __future__ import annotations

import ctypes
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils.flop_counter import FlopCounterMode

from sphericalvision.core import MissingCompilerError, check_choice, kernels, reference_kernels
from sphericalvision.crown import HexConv2d
from sphericalvision.icosphere import num_icosphere_vertices
from sphericalvision.recipes.app.cli import console

__all__ = [
    "OURS",
    "Comparison",
    "Measurement",
    "Run",
    "added_memory",
    "count_gflop",
    "measure",
    "prepare_operators",
    "random_images",
    "ways",
]

OURS = "sphericalvision"

Run = Callable[[], Any]


@dataclass(frozen=True)
class Comparison:
    """Functions that do the same work.

    Attributes:
        title: what the work is.
        runs: name -> function without arguments; ratios refer to the first.
        note: a line below the table.
        unit: "s": functions are timed; "MB": they return what was measured, and run three times.
    """

    title: str
    runs: Mapping[str, Run]
    note: str = ""
    unit: str = "s"


@dataclass(frozen=True)
class Measurement:
    """What came out for one function.

    Attributes:
        title: the work that it does.
        name: of the function.
        median: over all rounds, in the comparison's unit.
        spread: half the distance between the quartiles, as a share of the median.
        ratio: how often this fits into the first function's: above 1 is faster, or smaller.
        cpu: seconds of all threads together, which other processes hardly change; None of what is not timed.
        first: seconds of the first call, which compiles and fills caches; None of what is not timed.
        unit: of the median.
        note: of the comparison.
    """

    title: str
    name: str
    median: float
    spread: float
    ratio: float
    cpu: float | None
    first: float | None
    unit: str
    note: str


def measure(
    comparison: Comparison, seconds: float = 2.0, device: torch.device | str = "cpu", most_rounds: int = 50
) -> list[Measurement]:
    """Run all functions in turns until each has had ``seconds`` (three rounds at least), after one to warm up.

    Ratios are medians over rounds, so that both sides of a ratio have met the same state of the machine.
    """
    timed = comparison.unit == "s"
    runs = comparison.runs
    first = {name: _time(run, device)[0] for name, run in runs.items()} if timed else {}
    walls: dict[str, list[float]] = {name: [] for name in runs}
    cpus: dict[str, list[float]] = {name: [] for name in runs}
    for done in range(most_rounds):
        if done >= 3 and (not timed or max(map(sum, walls.values())) >= seconds):
            break
        for name, run in runs.items():
            wall, cpu = _time(run, device) if timed else (float(run()), 0.0)
            walls[name].append(wall)
            cpus[name].append(cpu)
    reference = next(iter(walls.values()))
    rows = []
    for name, column in walls.items():
        busy = statistics.median(cpus[name]) if timed else None
        facts = statistics.median(column), _spread(column), _ratio(reference, column), busy, first.get(name)
        rows.append(Measurement(comparison.title, name, *facts, comparison.unit, comparison.note))
    return rows


def _spread(column: Sequence[float]) -> float:
    low, median, high = statistics.quantiles(column, n=4)
    return (high - low) / 2 / median if median else 0.0


def _ratio(reference: Sequence[float], own: Sequence[float]) -> float:
    """Nothing at all is as good as nothing at all."""
    return statistics.median(
        a / b if b else 1.0 if a == b else float("inf") for a, b in zip(reference, own, strict=True)
    )


def _time(run: Run, device: torch.device | str) -> tuple[float, float]:
    """Seconds of one call on the clock and of the CPU; of a GPU, what it was left to do is waited for."""
    wait = partial(torch.cuda.synchronize, device) if torch.device(device).type == "cuda" else lambda: None
    wait()
    wall, cpu = time.perf_counter(), time.process_time()
    run()
    wait()
    return time.perf_counter() - wall, time.process_time() - cpu


def ways(run: Run, options: Sequence[str], device: torch.device, inference: bool = True) -> dict[str, Run]:
    """A run by the readable formulas ("plain"), as it is usually done, and in further ways.

    ``"layers"``: by layers in torch alone, as without a C++ compiler; ``"bf16"``: in bfloat16 where that pays.

    Raises:
        ArgumentError: an unknown option.
    """
    usual = torch.inference_mode()(run) if inference else run
    further = {
        "layers": kernels("plain")(usual),
        "bf16": torch.autocast(device.type, torch.bfloat16)(usual),
    }
    for option in options:
        check_choice("options", option, tuple(further))
    chosen = {f"{OURS}, {option}": further[option] for option in options}
    return {"plain": kernels("reference")(usual), OURS: usual, **chosen}


def prepare_operators(device: torch.device) -> None:
    """Wait for the operators in C++, so that they are used from the first call on; say so where they cannot be had."""
    if device.type != "cpu":
        return
    try:
        with kernels("require"), torch.no_grad():
            HexConv2d(1, 1)(torch.zeros(1, 1, 12))
    except MissingCompilerError as error:
        console.print(f"measured without operators in C++: {error}")


def random_images(level: int, device: torch.device, batch: int = 1) -> Tensor:
    """Images of four cameras on an icosphere."""
    return 2 * torch.rand(batch, 4, 3, num_icosphere_vertices(level), device=device) - 1


def count_gflop(run: Run) -> float:
    """Operations of convolutions and matrix products in 1e9, done directly; counted on shapes alone."""
    counter = FlopCounterMode(display=False)
    with torch.no_grad(), reference_kernels(), FakeTensorMode(allow_non_fake_inputs=True), counter:
        run()
    return float(counter.get_total_flops()) / 1e9


def added_memory(run: Run, device: torch.device) -> float:
    """MB by which a run raises what is in use above what is held before.

    Raises:
        AttributeError, OSError: the system does not tell; Linux does.
    """
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        held = torch.cuda.memory_allocated(device)
        run()
        return (torch.cuda.max_memory_allocated(device) - held) / 1e6
    ctypes.CDLL(None).malloc_trim(0)  # what was freed is given back, and counts when it is taken again
    Path("/proc/self/clear_refs").write_text("5")  # a new high-water mark
    before = _resident("VmRSS")
    run()
    return max(0.0, _resident("VmHWM") - before)


def _resident(field: str) -> float:
    """MB of memory in use (``VmRSS``) or at most so far (``VmHWM``)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith(field)) * 1024 / 1e6
