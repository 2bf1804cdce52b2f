# SPDX-License-Identifier: Apache-2.0
"""Measuring fairly: what is compared runs in turns, in one process, so that a busy machine slows all alike."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import torch

__all__ = ["BF16", "Comparison", "Measurement", "measure", "peaks_of", "share_of_peak"]

Run = Callable[[], Any]

BF16 = ", bf16"
"""Ends the name of a function that computes in bfloat16: its share is that of the bfloat16 peak."""


@dataclass(frozen=True)
class Comparison:
    """Functions that do the same work.

    Attributes:
        title: what the work is.
        runs: name -> function without arguments. It is timed, unless ``unit`` says that it returns a measurement.
        reference: the name that ratios refer to.
        gflop: floating-point operations that the work needs when done directly, in 1e9; None where it moves data.
        gbyte: bytes that the work must read and write at least once, in 1e9.
        note: a line below the table.
        unit: "s"; or "reported s", "MB", "%" for functions that return what was measured, which run ``rounds`` times.
        rounds: how often functions run that return what was measured.
        peak: "FLOP" or "byte" for functions that find out what the machine can do.
    """

    title: str
    runs: Mapping[str, Run]
    reference: str
    gflop: float | None = None
    note: str = ""
    gbyte: float | None = None
    unit: str = "s"
    rounds: int = 1
    peak: str | None = None


@dataclass(frozen=True)
class Measurement:
    """What came out for one function.

    Attributes:
        comparison: the work that it does.
        name: of the function.
        median: over all rounds, in the comparison's unit.
        spread: half the distance between the quartiles, as a share of the median.
        ratio: how often this fits into the reference: above 1 is faster, or smaller.
        first: seconds of the first call, which compiles and fills caches; None for reported measurements.
        share: of the speed that the machine's peaks allow for this work; None where they were not measured.
        rounds: number of measurements.
    """

    comparison: Comparison
    name: str
    median: float
    spread: float = 0.0
    ratio: float = 1.0
    first: float | None = None
    share: float | None = None
    rounds: int = 1

    @property
    def unit(self) -> str:
        """ "s", "MB" or "%"."""
        return self.comparison.unit.removeprefix("reported ")

    @property
    def facts(self) -> dict[str, Any]:
        """All of it as plain values."""
        own = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "comparison"}
        work = {key: getattr(self.comparison, key) for key in ("title", "gflop", "gbyte", "peak", "note")}
        return {**work, **own, "unit": self.unit}


def peaks_of(rows: Iterable[Measurement]) -> dict[str, float]:
    """What rows of the group ``machine`` reached at best: operations (in bfloat16, too) and bytes a second."""
    best: dict[str, float] = {}
    for row in rows:
        work = row.comparison
        amount = work.gflop if work.peak == "FLOP" else work.gbyte
        if work.peak is not None and amount is not None:
            key = work.peak + (BF16 if row.name.endswith(BF16) else "")
            best[key] = max(best.get(key, 0.0), amount * 1e9 / row.median)
    return best


def share_of_peak(peaks: Mapping[str, float], work: Comparison, name: str, seconds: float) -> float | None:
    """The least time that operations and traffic allow, as a share of the seconds that were taken.

    Examples:
        >>> work = Comparison("stage", {}, "", gflop=50.0, gbyte=8.0)
        >>> share_of_peak({"FLOP": 100e9, "byte": 10e9}, work, "ours", seconds=2.0)  # traffic takes 0.8 s
        0.4
    """
    operations = "FLOP" + (BF16 if name.endswith(BF16) else "")
    floors = [
        amount * 1e9 / peaks[peak]
        for amount, peak in ((work.gflop, operations), (work.gbyte, "byte"))
        if amount is not None and peak in peaks
    ]
    return max(floors) / seconds if floors and work.peak is None else None


def measure(
    comparison: Comparison,
    seconds: float = 2.0,
    device: torch.device | str = "cpu",
    most_rounds: int = 50,
    peaks: Mapping[str, float] | None = None,
) -> list[Measurement]:
    """Run all functions in turns until each has had ``seconds`` (three rounds at least), after one to warm up.

    Ratios are medians over rounds, so that both sides of a ratio have met the same state of the machine. Functions
    that report their own measurement run ``comparison.rounds`` times.
    """
    runs = comparison.runs
    first: dict[str, float] = {}
    columns: dict[str, list[float]] = {name: [] for name in runs}
    if comparison.unit == "s":
        first = {name: _timed(run, device) for name, run in runs.items()}
        while not _enough(columns, seconds, most_rounds):
            for name, run in runs.items():
                columns[name].append(_timed(run, device))
    else:
        for _ in range(comparison.rounds):
            for name, run in runs.items():
                columns[name].append(float(run()))
    rows = []
    for name, column in columns.items():
        median = statistics.median(column)
        share = share_of_peak(peaks or {}, comparison, name, median) if comparison.unit == "s" else None
        ratio = _ratio(columns[comparison.reference], column)
        rows.append(
            Measurement(comparison, name, median, _spread(column), ratio, first.get(name), share, len(column))
        )
    return rows


def _enough(columns: Mapping[str, list[float]], seconds: float, most_rounds: int) -> bool:
    rounds = min(len(column) for column in columns.values())
    slowest = max(sum(column) for column in columns.values())
    return rounds >= 3 and (slowest >= seconds or rounds >= most_rounds)


def _spread(column: list[float]) -> float:
    median = statistics.median(column)
    if len(column) < 2 or median == 0:
        return 0.0
    low, _, high = statistics.quantiles(column, n=4)
    return (high - low) / 2 / abs(median)


def _ratio(reference: list[float], own: list[float]) -> float:
    """Nothing at all is as good as nothing at all."""
    return statistics.median(
        a / b if b else 1.0 if a == b else float("inf") for a, b in zip(reference, own, strict=True)
    )


def _timed(run: Run, device: torch.device | str) -> float:
    """Seconds of one call, the work that it left on the device included; by the device's clock where it has one."""
    if torch.device(device).type != "cuda":
        start = time.perf_counter()
        run()
        return time.perf_counter() - start
    begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    torch.cuda.synchronize(device)
    begin.record()
    run()
    end.record()
    torch.cuda.synchronize(device)
    return begin.elapsed_time(end) / 1e3
