# SPDX-License-Identifier: Apache-2.0
"""Fair measuring: all ways to do the same work run in turns, in one process, so that a busy machine slows all alike."""

import ctypes
import os
import platform
import re
import statistics
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch.utils.benchmark import timer  # waits for a GPU

from sphericalvision.core import MissingCompilerError, check_choice
from sphericalvision.crown import HexConv2d
from sphericalvision.io.files import write_bytes
from sphericalvision.kernels import kernels
from sphericalvision.recipes.app.cli import console
from sphericalvision.recipes.evaluation.records import write_json
from sphericalvision.recipes.evaluation.tables import Table
from sphericalvision.threads import thread_policy

OURS = "sphericalvision"
MIN_ROUNDS, MAX_ROUNDS = 3, 50

Run = Callable[[], Any]


class Comparison(NamedTuple):
    """Functions that do the same work.

    Attributes:
        title: the work.
        runs: name -> function without arguments; ratios refer to the first.
        note: a line below the table.
        unit: "s": functions are timed; any other: they return a measured number, and run once.
    """

    title: str
    runs: Mapping[str, Run]
    note: str = ""
    unit: str = "s"


class Measurement(NamedTuple):
    """The result for one function.

    Attributes:
        title: its work.
        name: of the function.
        median: over all rounds, in the comparison's unit.
        spread: half the distance between the quartiles, relative to the median.
        ratio: how often this fits into the first function's: above 1 is faster, or smaller.
        cpu: seconds of all threads together, which other processes hardly change; 0 if it was not timed.
        unit: of the median.
        note: of the comparison.
    """

    title: str
    name: str
    median: float
    spread: float
    ratio: float
    cpu: float
    unit: str
    note: str


def measure(comparison: Comparison, seconds: float = 2.0, min_rounds: int = MIN_ROUNDS) -> list[Measurement]:
    """Run all functions in turns until one has had ``seconds`` (some rounds at least), after one round to warm up.

    Ratios are medians over rounds, so that both sides of a ratio have met the same state of the machine.
    """
    title, runs, note, unit = comparison
    rounds: list[list[tuple[float, float]]] = []  # seconds on the clock, and of the CPU
    if unit == "s":
        for run in runs.values():
            run()
        while len(rounds) < min_rounds or (
            len(rounds) < MAX_ROUNDS and np.sum(rounds, 0)[:, 0].max() < seconds
        ):
            rounds.append([_time(run) for run in runs.values()])
    else:  # a number, asked for once
        rounds.append([(float(run()), 0.0) for run in runs.values()])
    values, cpus = np.moveaxis(np.array(rounds), 2, 0)
    low, median, high = np.quantile(values, (0.25, 0.5, 0.75), axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):  # no memory at all is as good as none
        spreads = np.nan_to_num((high - low) / 2 / median)
        ratios = np.nan_to_num(np.median(values[:, :1] / values, 0), nan=1.0, posinf=np.inf)
    columns = (column.tolist() for column in (median, spreads, ratios, np.median(cpus, 0)))
    return [
        Measurement(title, name, center, spread, ratio, cpu, unit, note)
        for name, center, spread, ratio, cpu in zip(runs, *columns, strict=True)
    ]


def _time(run: Run) -> tuple[float, float]:
    """Seconds of one call, on the clock and of the CPU."""
    wall, cpu = timer(), time.process_time()
    run()
    return timer() - wall, time.process_time() - cpu


def ways(run: Run, options: Sequence[str], device: torch.device, inference: bool = True) -> dict[str, Run]:
    """A run by the readable formulas ("plain"), by the default kernels, and in further ways.

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
    """Wait for the operators in C++, so that they are used from the first call on; report a missing compiler."""
    if device.type != "cpu":
        return
    try:
        with kernels("require"), torch.no_grad():
            HexConv2d(1, 1)(torch.zeros(1, 1, 12))
    except MissingCompilerError as error:
        console.print(f"measured without operators in C++: {error}")


def added_memory(run: Run, device: torch.device) -> float:
    """MB by which a run raises the memory in use: the median of three.

    Raises:
        AttributeError, OSError: the system is not Linux.
    """

    def most() -> float:
        """Bytes that were in use at once since the mark."""
        if device.type == "cuda":
            return torch.cuda.max_memory_allocated(device)
        status = Path("/proc/self/status").read_text()
        return 1024 * int(re.findall(r"VmHWM:\s+(\d+)", status)[0])

    added = []
    for _ in range(3):
        if device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(device)
        else:
            # Freed memory is given back, and counts when it is allocated again
            ctypes.CDLL(None).malloc_trim(0)
            Path("/proc/self/clear_refs").write_text("5")  # a new high-water mark
        before = most()
        run()
        added.append((most() - before) / 1e6)
    return statistics.median(added)


def machine(device: torch.device) -> dict[str, str]:
    """The machine, the software and the commit of the source tree, as far as the system tells."""
    processor, commit = platform.processor() or platform.machine(), ""
    with suppress(OSError):
        processor = re.findall(r"model name\s*: (.+)", Path("/proc/cpuinfo").read_text())[0]
    with suppress(OSError):
        command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
        commit = subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
    return {
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU",
        "processor": f"{processor}, {torch.backends.cpu.get_cpu_capability()}",
        "cores": str(os.cpu_count()),
        "threads": f"{torch.get_num_threads()} ({thread_policy()})",
        "torch": torch.__version__,
        "python": platform.python_version(),
        "commit": commit,
    }


def comparison_table(rows: Sequence[Measurement]) -> Table:
    """The measurements of one comparison; "a second" is how often the work is done in one."""
    cells = []
    for row in rows:
        spread = cpu = rate = ""
        if row.unit == "s":
            spread, cpu, rate = f"{row.spread:.0%}", _amount(row.cpu, "s"), f"{1 / row.median:.3g}"
        cells.append([row.name, _amount(row.median, row.unit), spread, f"{row.ratio:.2f}", cpu, rate])
    return Table(rows[0].title, ["", "median", "±", "ratio", "CPU", "a second"], cells)


def save_measurements(folder: Path, rows: Sequence[Measurement], facts: Mapping[str, str]) -> list[Path]:
    """Write all comparisons as ``speed.md`` and ``speed.json``."""
    text = [", ".join(f"{key} {value}" for key, value in facts.items() if value) + "\n"]
    for title, group in groupby(rows, lambda row: row.title):
        measured = list(group)
        text += [f"### {title}\n", comparison_table(measured)._replace(title=measured[0].note).markdown()]
    write_bytes(folder / "speed.md", "\n".join(text).encode())
    write_json(folder / "speed.json", {"machine": dict(facts), "rows": [row._asdict() for row in rows]})
    return [folder / "speed.md", folder / "speed.json"]


def _amount(value: float, unit: str) -> str:
    """Three digits and a unit.

    Examples:
        >>> _amount(0.0123, "s"), _amount(2.5, "s"), _amount(1234.5, "MB")
        ('12.3 ms', '2.50 s', '1234 MB')
    """
    if unit != "s":
        return f"{value:.0f} {unit}" if value >= 10 else f"{value:.3g} {unit}"
    return f"{value * 1e3:.3g} ms" if value < 1 else f"{value:.3g} s" if value >= 10 else f"{value:.2f} s"
