# SPDX-License-Identifier: Apache-2.0
"""Charts of the tables in the pages: a number stands in its table alone."""

from __future__ import annotations

import math
import re
from pathlib import Path

from figures import CHARTS, FAINT, INK, MARK, new_figure, to_html

PAGES = Path(__file__).parents[1]
CLOSE = 1.3
"""Ratio of two times whose names would overlap."""
TICKS = (0.1, 0.2, 0.5, 1, 2, 5, 10)
"""CPU seconds."""


def table(page: str, heading: str) -> tuple[list[str], dict[str, list[float]]]:
    """The first table after ``heading``: its head, and each row's numbers by its name; brackets are left out."""
    text = (PAGES / page).read_text().partition(heading)[2]
    rows = []
    for line in text.splitlines():
        if line.startswith("|"):
            rows.append([cell.strip() for cell in line.strip("| ").split("|")])
        elif rows:
            break
    return rows[0][1:], {row[0].strip("`"): numbers(row[1:]) for row in rows[2:]}


def numbers(cells: list[str]) -> list[float]:
    """The number with which each cell begins."""
    found = (re.match(r"\**([\d.]+)", cell) for cell in cells)
    return [float(number[1]) if number else float("nan") for number in found]


def benchmark() -> str:
    """Mean errors of all methods on clean images, with all disturbances, and outdoors."""
    methods, rows = table("depth-benchmark.md", "### MAE at level 4")
    figure = new_figure(4.2, 4.2)
    axes = figure.add_axes((0.34, 0.12, 0.63, 0.86))
    tracks = {"clean": INK, "together": CHARTS[1], "outdoors": CHARTS[2]}
    for number, (track, color) in enumerate(tracks.items()):
        places = [place + 0.27 * (number - 1) for place in range(len(methods))]
        axes.barh(places, rows[track], 0.25, color=color, label=track)
    axes.set_yticks(range(len(methods)), methods)
    axes.get_yticklabels()[methods.index("refinedsweepnet")].set_color(MARK)
    axes.invert_yaxis()
    axes.set_xlabel("mean error, percent of N")
    axes.grid(axis="x", color=FAINT, alpha=0.3)
    axes.legend(loc="lower right")
    return to_html(
        figure,
        "Bars of the mean error of each method on clean images, with all disturbances together, and outdoors",
        "Mean error at the vertices of level 4, from the table below. 1 % is about 8 cm at two metres.",
    )


def presets() -> str:
    """Error of each preset against the time of a frame."""
    head, rows = table("how-do-i.md", "What the time buys")
    figure = new_figure(4.2, 3.0)
    axes = figure.add_axes((0.13, 0.17, 0.84, 0.8))
    seconds = [row[head.index("CPU s")] for row in rows.values()]
    for color, column in zip(
        CHARTS, ("clean", "disturbed", "other worlds"), strict=False
    ):
        errors = [row[head.index(column)] for row in rows.values()]
        axes.plot(seconds, errors, "o-", color=color, label=column)
    around = [0.0, *seconds, math.inf]
    for place, (name, row) in enumerate(rows.items()):
        before, second, after = around[place : place + 3]
        axes.annotate(
            name,
            (second, max(row[2:])),
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
    axes.set_ylim(0, 1.25 * max(max(row[2:]) for row in rows.values()))
    axes.grid(color=FAINT, alpha=0.3)
    axes.legend(loc="lower left")
    return to_html(
        figure,
        "Error of each preset against the CPU time of a frame, for clean, disturbed and other scenes",
        "What the time buys, from the table below. Lower is better.",
    )
