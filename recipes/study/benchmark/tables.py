# SPDX-License-Identifier: Apache-2.0
"""The tables of the benchmark, from the scores of all tracks and methods."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sphericalvision.metrics.spread import Interval
from sphericalvision.recipes.study.benchmark.records import Record
from sphericalvision.recipes.study.benchmark.scoring import KEPT, REGIONS
from sphericalvision.recipes.study.benchmark.summary import interval_of, values_of
from sphericalvision.recipes.study.benchmark.tracks import Track

__all__ = ["Measured", "TextTable", "all_tables"]


@dataclass(frozen=True)
class Measured:
    """All that was measured.

    Attributes:
        tracks: in the order of the tables.
        methods: names, likewise.
        records: track's name -> method's name -> its record.
        level: icosphere on which truth is dense.
    """

    tracks: Sequence[Track]
    methods: Sequence[str]
    records: Mapping[str, Mapping[str, Record]]
    level: int

    def scores(self, track: Track, method: str) -> Mapping[str, Any]:
        """Scores of a method on the frames of a track."""
        return self.records[track.name][method].scores

    def mean(self, method: str, *path: str) -> float:
        """Mean of one number over the frames of all tracks that have it; NaN if none has."""
        every = [v for track in self.tracks for v in values_of(self.scores(track, method), *path)]
        known = [value for value in every if not math.isnan(value)]
        return math.fsum(known) / len(known) if known else math.nan


@dataclass(frozen=True)
class TextTable:
    """A table of texts: the first column to the left, the others to the right.

    Attributes:
        title: what the numbers are.
        columns: headings.
        rows: cells.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]

    def markdown(self) -> str:
        """As Markdown, the title above."""
        lines = [f"| {' | '.join(self.columns)} |", "|---|" + "---:|" * (len(self.columns) - 1)]
        lines += [f"| {' | '.join(row)} |" for row in self.rows]
        return f"{self.title}\n\n" + "\n".join(lines)

    def html(self) -> str:
        """As HTML."""
        head = "".join(f"<th>{html.escape(text)}</th>" for text in self.columns)
        body = "".join(
            "<tr>" + "".join(f"<td>{html.escape(text)}</td>" for text in row) + "</tr>\n" for row in self.rows
        )
        return f"<p>{html.escape(self.title)}</p>\n<table><tr>{head}</tr>\n{body}</table>"


def all_tables(measured: Measured) -> dict[str, TextTable]:
    """The tables by name; the one of tilts only where there are such tracks."""
    coarse, fine = f"level {measured.level - 2}", f"level {measured.level}"
    tables = {
        "mae": _by_track(measured, f"MAE at {coarse}", ("coarse", "all", "MAE")),
        "mae_fine": _by_track(measured, f"MAE at {fine}", ("fine", "all", "MAE")),
        "panorama": _by_track(measured, "MAE on a panorama, by solid angle", ("panorama", "MAE")),
        "above_1": _by_track(measured, f"Points off by more than 1 % at {coarse}", ("coarse", "all", ">1")),
        "rms": _by_track(measured, f"RMS at {coarse}", ("coarse", "all", "RMS")),
        "relative": _by_track(
            measured,
            f"Mean relative error of the depth in metres, AbsRel, at {coarse}",
            ("metres", "AbsRel"),
            3,
        ),
        "within": _by_track(
            measured,
            f"Share of depths within a factor 1.25 at {coarse}",
            ("metres", "d<1.25"),
            3,
            best=max,
        ),
        "regions": _by_region(measured, fine),
    }
    if len([track for track in measured.tracks if track.shared_tilts_deg]) > 1:
        tables["drift"] = _drift(measured, coarse)
    return {**tables, "confidence": _confidence(measured, coarse), "cost": _cost(measured)}


def _by_track(
    measured: Measured,
    title: str,
    path: tuple[str, ...],
    digits: int = 2,
    best: Callable[[Sequence[float]], float] = min,
) -> TextTable:
    rows = []
    for track in measured.tracks:
        intervals = [interval_of(measured.scores(track, method), *path) for method in measured.methods]
        means = [interval.mean for interval in intervals if not math.isnan(interval.mean)]
        winner = best(means) if len(means) > 1 else math.nan
        rows.append([track.name, *(_interval(i, digits, i.mean == winner) for i in intervals)])
    scenes = max(len(measured.scores(t, m)) for t in measured.tracks for m in measured.methods)
    about = f"{title}: mean over {scenes} scenes, and in brackets 95 % of the bootstrap means over scenes."
    return TextTable(about, ["track", *measured.methods], rows)


def _interval(interval: Interval, digits: int, best: bool) -> str:
    if math.isnan(interval.mean):
        return "–"
    mean, low, high = (f"{value:.{digits}f}" for value in interval)
    return f"**{mean}** ({low}–{high})" if best else f"{mean} ({low}–{high})"


def _by_region(measured: Measured, level: str) -> TextTable:
    rows = []
    for region in REGIONS[:-1]:
        share = measured.mean(measured.methods[0], "points", region)
        errors = [measured.mean(method, "fine", region, "MAE") for method in measured.methods]
        rows.append([region, _number(share, 1), *map(_number, errors)])
    title = f"MAE at {level} by kind of place: mean over the frames of all tracks that have such places."
    return TextTable(title, ["place", "% of points", *measured.methods], rows)


def _drift(measured: Measured, level: str) -> TextTable:
    tracks = sorted((t for t in measured.tracks if t.shared_tilts_deg), key=lambda t: t.rig.tilt_deg)
    rows = []
    for method in measured.methods:
        means = [
            interval_of(measured.scores(track, method), "coarse", "shared", "MAE").mean for track in tracks
        ]
        rows.append([method, *(f"{_number(mean)} (x{_number(mean / means[0])})" for mean in means)])
    title = (
        f"MAE at {level} of the same points, those that two cameras see at every tilt, and its ratio to the "
        "first column's."
    )
    return TextTable(title, ["method", *(f"{track.rig.tilt_deg:g}°" for track in tracks)], rows)


def _confidence(measured: Measured, level: str) -> TextTable:
    rows = []
    for method in measured.methods:
        every = measured.mean(method, "kept", "1")
        kept = [measured.mean(method, "kept", f"{share:g}") / every for share in KEPT[1:]]
        rows.append([method, *map(_number, (every, *kept))])
    columns = ["method", "MAE of all", *(f"surest {100 * share:g} %" for share in KEPT[1:])]
    title = f"MAE at {level} of the points of which a method is surest, as a ratio to that of all; mean over tracks."
    return TextTable(title, columns, rows)


def _cost(measured: Measured) -> TextTable:
    rows = []
    for method in measured.methods:
        records = [measured.records[track.name][method] for track in measured.tracks]
        cost = next((record.cost for record in records if record.cost is not None), None)
        seconds = sorted(v for record in records for v in values_of(record.scores, "seconds"))
        operations = None if cost is None else cost["gflop"]
        parameters = "–" if cost is None else f"{cost['parameters']:,}"
        median = _number(seconds[len(seconds) // 2]) if seconds else "–"
        rows.append([method, parameters, "–" if operations is None else f"{operations:.1f}", median])
    title = (
        "What a frame takes: operations of matrices and convolutions in the reference kernels, and CPU seconds on "
        "one thread (median)."
    )
    return TextTable(title, ["method", "parameters", "GFLOP", "CPU s"], rows)


def _number(value: float, digits: int = 2) -> str:
    return "–" if math.isnan(value) else f"{value:.{digits}f}"
