# SPDX-License-Identifier: Apache-2.0
"""The tables of the benchmark, and the machine that made them in words."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import torch

from sphericalvision.recipes.app.cli import print_table
from sphericalvision.recipes.benchmark.measuring import Measured

__all__ = ["machine", "print_measured", "save_measured"]

COLUMNS = ["", "median", "±", "ratio", "first call", "GFLOP/s", "share of peak"]


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
    print_table(f"{rows[0].title}{_needs(rows[0])}", COLUMNS, [_cells(row) for row in rows])


def save_measured(folder: Path, rows: list[Measured], facts: Mapping[str, str]) -> list[Path]:
    """Write all comparisons as ``benchmark.md`` and ``benchmark.json``."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = [", ".join(f"{key} {value}" for key, value in facts.items() if value), ""]
    for title in dict.fromkeys(row.title for row in rows):
        own = [row for row in rows if row.title == title]
        lines += [f"### {title}{_needs(own[0])}", "", f"| {' | '.join(COLUMNS)} |", "|---|" + "---:|" * 6]
        lines += ["| " + " | ".join(_cells(row)) + " |" for row in own]
        lines += ["", own[0].note, ""] if own[0].note else [""]
    stored = {"machine": dict(facts), "rows": [asdict(row) for row in rows]}
    texts = {"benchmark.md": "\n".join(lines), "benchmark.json": json.dumps(stored, indent=2) + "\n"}
    for name, text in texts.items():
        unfinished = folder / f".{name}.unfinished"
        unfinished.write_text(text, encoding="utf-8")
        unfinished.replace(folder / name)
    return [folder / name for name in texts]


def _needs(row: Measured) -> str:
    """What the work takes at least."""
    amounts = [
        f"{amount:.3g} {unit}"
        for amount, unit in ((row.gflop, "GFLOP"), (row.gbyte, "GB"))
        if amount is not None
    ]
    return f" ({', '.join(amounts)})" if amounts else ""


def _cells(row: Measured) -> list[str]:
    timed = row.unit == "s"
    return [
        row.name,
        _amount(row.median, row.unit),
        f"{row.spread:.0%}" if row.rounds > 1 else "",
        f"{row.ratio:.2f}",
        "" if row.first is None else _amount(row.first, "s"),
        f"{row.gflop / row.median:.0f}" if timed and row.gflop is not None else "",
        "" if row.share is None else f"{row.share:.0%}",
    ]


def _amount(value: float, unit: str) -> str:
    """Three digits and a unit.

    Examples:
        >>> _amount(0.0123, "s"), _amount(2.5, "s"), _amount(1234.5, "MB"), _amount(3.25, "%")
        ('12.3 ms', '2.50 s', '1234 MB', '3.2 %')
    """
    if unit == "%":
        return f"{value:.1f} %"
    if unit != "s":
        return f"{value:.0f} {unit}"
    return f"{value * 1e3:.3g} ms" if value < 1 else f"{value:.3g} s" if value >= 10 else f"{value:.2f} s"
