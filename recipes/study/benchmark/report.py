# SPDX-License-Identifier: Apache-2.0
"""What the benchmark writes: tables as Markdown, everything as JSON, and a page with the pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sphericalvision.io.files import atomic_write
from sphericalvision.recipes.study.benchmark.summary import interval_of, mean_scores
from sphericalvision.recipes.study.benchmark.tables import Measured, TextTable, all_tables
from sphericalvision.recipes.study.training import write_json

__all__ = ["report"]

STYLE = "body{font:14px sans-serif} td,th{padding:2px 8px;text-align:right} td:first-child{text-align:left}"


def report(folder: Path, measured: Measured) -> list[TextTable]:
    """Write ``benchmark.md``, ``benchmark.json`` and ``index.html``; returns the tables."""
    tables = list(all_tables(measured).values())
    with atomic_write(folder / "benchmark.md") as temporary:
        parts = ["# Benchmark of depth methods", *(table.markdown() for table in tables)]
        Path(temporary).write_text("\n\n".join(parts) + "\n")
    write_json(folder / "benchmark.json", _numbers(measured))
    with atomic_write(folder / "index.html") as temporary:
        Path(temporary).write_text(_web_page(folder, measured, tables))
    return tables


def _numbers(measured: Measured) -> dict[str, Any]:
    """Means, and intervals of the MAE, by track and method."""
    return {
        track.name: {
            method: {
                "frames": len(measured.scores(track, method)),
                "means": mean_scores(measured.scores(track, method)),
                "MAE": interval_of(measured.scores(track, method), "coarse", "all", "MAE")._asdict(),
                "cost": measured.records[track.name][method].cost,
            }
            for method in measured.methods
        }
        for track in measured.tracks
    }


def _web_page(folder: Path, measured: Measured, tables: Sequence[TextTable]) -> str:
    names = [track.name for track in measured.tracks]
    pictures = [
        f'<h2>{name}</h2>\n<img src="pages/{name}.png" loading="lazy" style="max-width:100%">'
        for name in names
        if (folder / "pages" / f"{name}.png").is_file()
    ]
    head = f"<!doctype html><meta charset=utf-8><title>Benchmark</title>\n<style>{STYLE}</style>"
    return "\n".join([head, *(table.html() for table in tables), *pictures]) + "\n"
