# SPDX-License-Identifier: Apache-2.0
"""Tables and charts of results: files of ``docs/data`` as the commands wrote them."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from figures import CHARTS, FAINT, INK, MARK, new_figure, to_html
from sphericalvision.recipes.evaluation.tables import Cell, Table

PAGES = Path(__file__).parents[1]
SHOWN = "MAE at level 4"
"""The table of the benchmark that its page has in the open."""
CLOSE = 1.3
"""Ratio of two times whose names would overlap."""
TICKS = (0.1, 0.2, 0.5, 1, 2, 5, 10)
"""CPU seconds."""


def read(name: str) -> dict[str, Any]:
    """The content of a file of ``docs/data``."""
    return json.loads((PAGES / "data" / f"{name}.json").read_text())


def write(name: str, tables: Mapping[str, Table]) -> None:
    """Write tables, by heading, to a file of ``docs/data``, as the benchmark writes its ``tables.json``; print them."""
    lines = [
        f"{json.dumps(heading)}: {json.dumps(table._asdict())}"
        for heading, table in tables.items()
    ]
    file = PAGES / "data" / f"{name}.json"
    file.write_text("{\n" + ",\n".join(lines) + "\n}\n")
    for table in tables.values():
        table.print()


def markdown(name: str, heading: str) -> str:
    """A table of the benchmark, a study or what ``write`` wrote, its title above it."""
    table = Table.of(read(name)[heading])
    rows = table._replace(title="").markdown()
    return f"{table.title}\n\n{rows}" if table.title else rows


def rest_of_benchmark() -> str:
    """The tables that are folded away."""
    tables = {k: Table.of(v) for k, v in read("benchmark").items() if k != SHOWN}
    return "\n".join(
        f"<details><summary>{heading}</summary>\n{table.html()}</details>"
        for heading, table in tables.items()
    )


def benchmark() -> str:
    """Mean errors of all methods on clean images, with all disturbances, and outdoors."""
    table = Table.of(read("benchmark")["MAE at level 4"])
    methods, rows = table.columns[1:], {row[0]: row[1:] for row in table.rows}
    figure = new_figure(4.2, 4.2)
    axes = figure.add_axes((0.34, 0.12, 0.63, 0.86))
    tracks = {"clean": INK, "together": CHARTS[1], "outdoors": CHARTS[2]}
    for number, (track, color) in enumerate(tracks.items()):
        heights = [height + 0.27 * (number - 1) for height in range(len(methods))]
        means = [
            cell.mean if isinstance(cell, Cell) else math.nan
            for cell in rows[track]
        ]
        axes.barh(heights, means, 0.25, color=color, label=track)
    axes.set_yticks(range(len(methods)), methods)
    axes.get_yticklabels()[methods.index("refinedsweepnet")].set_color(MARK)
    axes.invert_yaxis()
    axes.set_xlabel("mean error, percent of N")
    axes.grid(axis="x", color=FAINT, alpha=0.3)
    axes.legend(loc="lower right")
    return to_html(
        figure,
        "Bars of the mean error of each method on clean images, with all disturbances together, and outdoors",
        "Mean error at the vertices of level 4. 1 % is about 8 cm at two metres.",
    )


def preset_rows() -> dict[str, dict[str, float]]:
    """Preset -> CPU seconds, memory and errors, as ``sphericalvision-speed groups=[presets]`` measured them."""
    rows: dict[str, dict[str, float]] = {}
    for row in read("presets")["rows"]:
        condition = re.search(r", \d+ (.+) scenes", row["title"])
        column = (
            condition[1]
            if condition
            else {"s": "CPU s", "MB": "memory"}[row["unit"]]
        )
        value = row["cpu"] if row["unit"] == "s" else row["median"]
        rows.setdefault(row["name"], {})[column] = value
    return rows


def preset_table() -> str:
    """The rows of presets as Markdown."""
    rows = preset_rows()
    columns = [
        "CPU s",
        "memory",
        *(k for k in rows["default"] if k not in ("CPU s", "memory")),
    ]
    cells = [
        [
            f"`{name}`" if name != "default" else name,
            *(
                f"{row[c]:.0f} MB" if c == "memory" else f"{row[c]:.2f}"
                for c in columns
            ),
        ]
        for name, row in rows.items()
    ]
    return Table("", ("preset", *columns), cells).markdown()


def presets() -> str:
    """Error of each preset against the time of a frame."""
    rows = preset_rows()
    figure = new_figure(4.2, 3.0)
    axes = figure.add_axes((0.13, 0.17, 0.84, 0.8))
    seconds = [row["CPU s"] for row in rows.values()]
    conditions = [key for key in rows["default"] if key not in ("CPU s", "memory")]
    for color, column in zip(CHARTS, conditions, strict=False):
        errors = [row[column] for row in rows.values()]
        axes.plot(seconds, errors, "o-", color=color, label=column)
    worst = {
        name: max(row[key] for key in conditions) for name, row in rows.items()
    }
    around = [0.0, *seconds, math.inf]
    for index, name in enumerate(rows):
        before, second, after = around[index : index + 3]
        axes.annotate(
            name,
            (second, worst[name]),
            (0, 6),
            textcoords="offset points",
            # names of presets that take about as long go apart
            ha="right"
            if after < CLOSE * second
            else "left"
            if before > second / CLOSE
            else "center",
        )
    axes.set(
        xscale="log", xlabel="CPU seconds of a frame", ylabel="mean error, % of N"
    )
    ticks = [tick for tick in TICKS if tick < 1.5 * max(seconds)]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.set_ylim(0, 1.25 * max(worst.values()))
    axes.grid(color=FAINT, alpha=0.3)
    axes.legend(loc="lower left")
    return to_html(
        figure,
        "Error of each preset against the CPU time of a frame, for clean, disturbed and other scenes",
        "What the time buys, from the table below. Lower is better.",
    )
