# SPDX-License-Identifier: Apache-2.0
"""Measuring fairly: what is compared runs in turns, in one process, so that a busy machine slows all alike."""

from __future__ import annotations

import json
import os
import platform
import statistics
import subprocess
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch

from sphericalvision.recipes.cli import print_table

__all__ = ["Comparison", "Measured", "machine", "measure", "print_measured", "save_measured"]

Run = Callable[[], Any]


@dataclass(frozen=True)
class Comparison:
    """Functions that do the same work.

    Attributes:
        title: what the work is.
        runs: name -> function without arguments.
        reference: the name that ratios refer to.
        gflop: floating-point operations that the work needs when done directly, in 1e9; None where it moves data.
        note: a line below the table.
    """

    title: str
    runs: Mapping[str, Run]
    reference: str
    gflop: float | None = None
    note: str = ""


@dataclass(frozen=True)
class Measured:
    """What came out for one function: seconds a call, and how often the reference fits into them."""

    title: str
    name: str
    seconds: float
    spread: float
    ratio: float
    gflops: float | None
    rounds: int
    note: str = field(default="", repr=False)


def measure(
    comparison: Comparison, seconds: float = 2.0, device: torch.device | str = "cpu", most_rounds: int = 50
) -> list[Measured]:
    """Run all functions in turns until each has had ``seconds`` (three rounds at least), after one to warm up.

    Times are medians over rounds; ``spread`` is half the distance between the quartiles, as a share of the median;
    ``ratio`` is the median over rounds of the reference's time divided by this one's, so above 1 is faster.
    """
    names = list(comparison.runs)
    for name in names:
        _timed(comparison.runs[name], device)
    times: dict[str, list[float]] = {name: [] for name in names}
    while len(times[names[0]]) < 3 or (
        max(sum(column) for column in times.values()) < seconds and len(times[names[0]]) < most_rounds
    ):
        for name in names:
            times[name].append(_timed(comparison.runs[name], device))
    result = []
    for name in names:
        median = statistics.median(times[name])
        low, _, high = statistics.quantiles(times[name], n=4)
        pairs = zip(times[comparison.reference], times[name], strict=True)
        result.append(
            Measured(
                comparison.title,
                name,
                median,
                (high - low) / 2 / median,
                statistics.median(theirs / own for theirs, own in pairs),
                None if comparison.gflop is None else comparison.gflop / median,
                len(times[name]),
                comparison.note,
            )
        )
    return result


def _timed(run: Run, device: torch.device | str) -> float:
    """Seconds of one call, the work that it left on the device included."""
    _synchronize(device)
    start = time.perf_counter()
    run()
    _synchronize(device)
    return time.perf_counter() - start


def _synchronize(device: torch.device | str) -> None:
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)


def machine(device: torch.device | str = "cpu") -> dict[str, str]:
    """The machine and the software in words.

    Examples:
        >>> sorted(machine())
        ['commit', 'cores', 'device', 'processor', 'python', 'threads', 'torch']
    """
    name = torch.cuda.get_device_name(device) if torch.device(device).type == "cuda" else "CPU"
    return {
        "device": name,
        "processor": _processor(),
        "cores": str(os.cpu_count()),
        "threads": str(torch.get_num_threads()),
        "torch": torch.__version__,
        "python": platform.python_version(),
        "commit": _commit(),
    }


def _processor() -> str:
    """Model and widest vector instructions, as far as the system tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    fields = dict(line.split(":", 1) for line in reversed(lines) if ":" in line)
    named = {key.strip(): value.strip() for key, value in fields.items()}
    return f"{named.get('model name', platform.machine())}, {torch.backends.cpu.get_cpu_capability()}"


def _commit() -> str:
    """Of the source tree that runs; empty when installed from a wheel."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    return answer.stdout.strip()


def print_measured(rows: list[Measured]) -> None:
    """Print one comparison."""
    columns = ["", "time", "± ", "times the speed", "GFLOP/s"]
    print_table(rows[0].title, columns, [_cells(row) for row in rows])


def save_measured(folder: Path, rows: list[Measured], facts: Mapping[str, str]) -> list[Path]:
    """Write all comparisons as ``benchmark.md`` and ``benchmark.json``."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = [", ".join(f"{key} {value}" for key, value in facts.items() if value), ""]
    for title in dict.fromkeys(row.title for row in rows):
        own = [row for row in rows if row.title == title]
        lines += [
            f"### {title}",
            "",
            "| | time | ± | times the speed | GFLOP/s |",
            "|---|---:|---:|---:|---:|",
        ]
        lines += ["| " + " | ".join(_cells(row)) + " |" for row in own]
        lines += ["", own[0].note, ""] if own[0].note else [""]
    texts = {
        "benchmark.md": "\n".join(lines),
        "benchmark.json": json.dumps(
            {"machine": dict(facts), "rows": [asdict(row) for row in rows]}, indent=2
        )
        + "\n",
    }
    for name, text in texts.items():
        unfinished = folder / f".{name}.unfinished"
        unfinished.write_text(text, encoding="utf-8")
        unfinished.replace(folder / name)
    return [folder / name for name in texts]


def _cells(row: Measured) -> list[str]:
    rate = "" if row.gflops is None else f"{row.gflops:.0f}"
    return [row.name, _duration(row.seconds), f"{row.spread:.0%}", f"{row.ratio:.2f}", rate]


def _duration(seconds: float) -> str:
    """Three digits and a unit.

    Examples:
        >>> _duration(0.0123), _duration(2.5)
        ('12.3 ms', '2.50 s')
    """
    return (
        f"{seconds * 1e3:.3g} ms"
        if seconds < 1
        else f"{seconds:.3g} s"
        if seconds >= 10
        else f"{seconds:.2f} s"
    )
