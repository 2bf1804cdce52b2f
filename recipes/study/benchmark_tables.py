# SPDX-License-Identifier: Apache-2.0
"""What the comparison writes: tables of all tracks and methods, everything as JSON, and a page with the pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from sphericalvision.metrics.spread import Interval, bootstrap_interval
from sphericalvision.recipes.evaluation.places import KEPT, REGIONS
from sphericalvision.recipes.evaluation.records import Errors, Record, values_of, write_json
from sphericalvision.recipes.evaluation.tables import Cell, Row, Table, save_report
from sphericalvision.recipes.evaluation.tracks import Track

__all__ = ["Results", "all_tables", "report"]


class Results(NamedTuple):
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

    def frames(self, track: Track, method: str) -> Mapping[str, Errors]:
        """Errors of a method on the frames of a track."""
        return self.records[track.name][method].frames

    def interval(self, track: Track, method: str, *path: str) -> Interval:
        """Mean over the frames of a track of one number, and its bootstrap interval of 95 % over scenes."""
        return bootstrap_interval(values_of(self.frames(track, method), *path))

    def mean(self, method: str, *path: str) -> float:
        """Mean of one number over the frames of all tracks that have it; NaN if none has."""
        every = [value for track in self.tracks for value in values_of(self.frames(track, method), *path)]
        numbers = [value for value in every if not math.isnan(value)]
        return math.fsum(numbers) / len(numbers) if numbers else math.nan


def report(folder: Path, results: Results) -> None:
    """Write ``benchmark.md``, ``benchmark.json`` and ``index.html``, and print the first table."""
    tables = all_tables(results)
    pictures = {track.name: f"pages/{track.name}.png" for track in results.tracks}
    save_report(folder, "benchmark", "Benchmark of depth methods", tables, pictures)
    write_json(
        folder / "benchmark.json",
        {
            track.name: {
                method: {
                    "frames": len(results.frames(track, method)),
                    "means": results.records[track.name][method].means,
                    "MAE": results.interval(track, method, "coarse", "all", "MAE")._asdict(),
                    "cost": results.records[track.name][method].cost,
                }
                for method in results.methods
            }
            for track in results.tracks
        },
    )
    next(iter(tables.values())).print()


MEANS = (
    ("MAE at {coarse}", "MAE at {coarse}", "coarse all MAE", 2),
    ("MAE at {fine}", "MAE at {fine}", "fine all MAE", 2),
    ("MAE on a panorama", "MAE on a panorama, by solid angle", "panorama MAE", 2),
    ("Points off by more than 1 %", "Points off by more than 1 % at {coarse}", "coarse all >1", 2),
    ("RMS at {coarse}", "RMS at {coarse}", "coarse all RMS", 2),
    ("Relative error", "Mean relative error of the depth in metres, AbsRel, at {coarse}", "metres AbsRel", 3),
    ("Within a factor of 1.25", "Share of depths within a factor 1.25 at {coarse}", "metres d<1.25", 3),
)
"""Tables of tracks by methods: heading, title, which of the errors, and its digits."""


def all_tables(results: Results) -> dict[str, Table]:
    """The tables by their headings; the one of tilts only where there are such tracks."""
    levels = {"coarse": f"level {results.level - 2}", "fine": f"level {results.level}"}
    tables = {
        heading.format(**levels): _by_track(results, title.format(**levels), path.split(), digits)
        for heading, title, path, digits in MEANS
    }
    tables["By kind of place"] = _by_region(results, levels["fine"])
    if len([track for track in results.tracks if track.shared_tilts_deg]) > 1:
        tables["Against tilt"] = _drift(results, levels["coarse"])
    tables["Of the surest points"] = _confidence(results, levels["coarse"])
    return {**tables, "Cost of a frame": _cost(results)}


def _by_track(results: Results, title: str, path: Sequence[str], digits: int) -> Table:
    best = max if path[-1] == "d<1.25" else min
    rows: list[Row] = []
    for track in results.tracks:
        intervals = [results.interval(track, method, *path) for method in results.methods]
        means = [interval.mean for interval in intervals if not math.isnan(interval.mean)]
        winner = best(means) if len(means) > 1 else math.nan
        cells = [
            None if math.isnan(i.mean) else Cell(i.mean, None, digits, (i.low, i.high), i.mean == winner)
            for i in intervals
        ]
        rows.append([track.name, *cells])
    scenes = max(len(results.frames(t, m)) for t in results.tracks for m in results.methods)
    about = f"{title}: mean over {scenes} scenes, and in brackets 95 % of the bootstrap means over scenes."
    return Table(about, ["track", *results.methods], [rows])


def _by_region(results: Results, level: str) -> Table:
    rows: list[Row] = []
    for region in REGIONS[:-1]:
        share = results.mean(results.methods[0], "points", region)
        errors = [results.mean(method, "fine", region, "MAE") for method in results.methods]
        rows.append([region, _number(share, 1), *map(_number, errors)])
    title = f"MAE at {level} by kind of place: mean over the frames of all tracks that have such places."
    return Table(title, ["place", "% of points", *results.methods], [rows])


def _drift(results: Results, level: str) -> Table:
    tracks = sorted((t for t in results.tracks if t.shared_tilts_deg), key=lambda t: t.rig.tilt_deg)
    rows: list[Row] = []
    for method in results.methods:
        means = [results.interval(track, method, "coarse", "shared", "MAE").mean for track in tracks]
        rows.append([method, *(f"{_number(mean)} (x{_number(mean / means[0])})" for mean in means)])
    title = (
        f"MAE at {level} of the same points, those that two cameras see at every tilt, and its ratio to the "
        "first column's."
    )
    return Table(title, ["method", *(f"{track.rig.tilt_deg:g}°" for track in tracks)], [rows])


def _confidence(results: Results, level: str) -> Table:
    rows: list[Row] = []
    for method in results.methods:
        every = results.mean(method, "kept", "1")
        ratios = [results.mean(method, "kept", f"{share:g}") / every for share in KEPT[1:]]
        rows.append([method, *map(_number, (every, *ratios))])
    columns = ["method", "MAE of all", *(f"surest {100 * share:g} %" for share in KEPT[1:])]
    title = f"MAE at {level} of the points of which a method is surest, as a ratio to that of all; mean over tracks."
    return Table(title, columns, [rows])


def _cost(results: Results) -> Table:
    rows: list[Row] = []
    for method in results.methods:
        records = [results.records[track.name][method] for track in results.tracks]
        cost = next((record.cost for record in records if record.cost is not None), None)
        seconds = sorted(v for record in records for v in values_of(record.frames, "seconds"))
        operations = None if cost is None else cost["gflop"]
        parameters = "–" if cost is None else f"{cost['parameters']:,}"
        median = _number(seconds[len(seconds) // 2]) if seconds else "–"
        rows.append([method, parameters, "–" if operations is None else f"{operations:.1f}", median])
    title = (
        "What a frame takes: operations of matrices and convolutions in the reference kernels, and CPU seconds on "
        "one thread (median)."
    )
    return Table(title, ["method", "parameters", "GFLOP", "CPU s"], [rows])


def _number(value: float, digits: int = 2) -> str:
    return "–" if math.isnan(value) else f"{value:.{digits}f}"
