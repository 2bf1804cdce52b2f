# SPDX-License-Identifier: Apache-2.0
"""The tables of speed, and the machine that made them in words."""

from __future__ import annotations

import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import groupby
from pathlib import Path

import torch

from sphericalvision.io.files import write_bytes
from sphericalvision.recipes.evaluation.records import write_json
from sphericalvision.recipes.evaluation.tables import Table
from sphericalvision.recipes.speed.measuring import Measurement

__all__ = ["comparison_table", "machine", "save_measurements"]

COLUMNS = ["", "median", "±", "ratio", "CPU", "a second", "first call"]


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


def comparison_table(rows: Sequence[Measurement]) -> Table:
    """The measurements of one comparison; "a second" is how often the work is done in one."""
    return Table(rows[0].title, COLUMNS, [[_cells(row) for row in rows]])


def save_measurements(folder: Path, rows: Sequence[Measurement], facts: Mapping[str, str]) -> list[Path]:
    """Write all comparisons as ``speed.md`` and ``speed.json``."""
    parts = [", ".join(f"{key} {value}" for key, value in facts.items() if value) + "\n"]
    for title, group in groupby(rows, lambda row: row.title):
        own = list(group)
        parts += [f"### {title}\n", comparison_table(own)._replace(title=own[0].note).markdown()]
    write_bytes(folder / "speed.md", "\n".join(parts).encode())
    write_json(folder / "speed.json", {"machine": dict(facts), "rows": [asdict(row) for row in rows]})
    return [folder / "speed.md", folder / "speed.json"]


def _cells(row: Measurement) -> list[str]:
    return [
        row.name,
        _amount(row.median, row.unit),
        f"{row.spread:.0%}",
        f"{row.ratio:.2f}",
        "" if row.cpu is None else _amount(row.cpu, "s"),
        "" if row.unit != "s" else f"{1 / row.median:.3g}",
        "" if row.first is None else _amount(row.first, "s"),
    ]


def _amount(value: float, unit: str) -> str:
    """Three digits and a unit.

    Examples:
        >>> _amount(0.0123, "s"), _amount(2.5, "s"), _amount(1234.5, "MB")
        ('12.3 ms', '2.50 s', '1234 MB')
    """
    if unit != "s":
        return f"{value:.0f} {unit}" if value >= 10 else f"{value:.3g} {unit}"
    return f"{value * 1e3:.3g} ms" if value < 1 else f"{value:.3g} s" if value >= 10 else f"{value:.2f} s"
