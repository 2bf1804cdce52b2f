# SPDX-License-Identifier: Apache-2.0
"""The tables of a study, from the numbers of its runs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sphericalvision.metrics import DepthIndexError
from sphericalvision.recipes.evaluation.tables import Cell, Row, Table, summarize

__all__ = ["change_table", "detail_table", "input_table", "paper_table", "zone_table"]

Result = dict[str, Any]
"""What the JSON of one model, seed and view holds: ``label``, ``inputs``, ``angle_deg``, ``seed``, ``errors``."""

PAPER_COLUMNS = DepthIndexError.error_names

DETAILS = (
    ("AbsRel", "depth", "AbsRel", 3),
    ("RMSE (m)", "depth", "RMSE", 2),
    ("d<1.25", "depth", "d<1.25", 3),
    ("MAE by solid angle", "solid_angle", "MAE", 2),
    ("OmniMVS protocol MAE", "omnimvs", "MAE", 2),
    ("MAE at seams", "seam", "MAE", 2),
    ("MAE off seams", "off_seam", "MAE", 2),
    ("MAE, nothing left out", "all", "MAE", 2),
    ("left out (%)", "points", "left_out", 1),
)
"""Heading, protocol, name and digits of each column of the details."""

ZONES = (
    ("above 30°", "above", "MAE", 2),
    ("within 30°", "around", "MAE", 2),
    ("below −30°", "below", "MAE", 2),
    ("2 cameras", "two", "MAE", 2),
    ("3 cameras", "three", "MAE", 2),
    ("4 or more", "four", "MAE", 2),
)
"""The same of the table of where errors are."""


def paper_table(results: list[Result]) -> Table:
    """The paper's table: ``>1 >3 >5 MAE RMS`` of each model at each angle."""
    columns = [(name, "paper", name, 2) for name in PAPER_COLUMNS]
    mine = _fisheye(results)
    shares = {r["angle_deg"]: r["errors"]["points"]["left_out"] for r in mine}
    left_out = ", ".join(f"{share:.1f} % at {angle:g}°" for angle, share in sorted(shares.items()))
    title = f"Percent of N = {_number(results)}; {_about(results)}. Left out, as fewer cameras see it: {left_out}."
    return _by_angle(mine, columns, title)


def detail_table(results: list[Result]) -> Table:
    """The other protocols, of each model at each angle."""
    title = (
        f"MAE in percent of N = {_number(results)}, but for that of the OmniMVS protocol (panorama within 45° of the "
        f"horizon, N = 192); depths up to 100 m; {_about(results)}. Left out: points that fewer than two cameras see."
    )
    return _by_angle(_fisheye(results), list(DETAILS), title)


def zone_table(results: list[Result]) -> Table:
    """MAE by latitude and by the number of cameras that see a point: where a model suffers from the angle."""
    title = f"MAE in percent of N = {_number(results)} by latitude and by cameras that see a point; {_about(results)}."
    return _by_angle(_fisheye(results), list(ZONES), title)


def change_table(results: list[Result]) -> Table:
    """MAE at each angle over the MAE of the same seed with level cameras: 1 is unmoved."""
    results = _fisheye(results)
    angles = sorted({r["angle_deg"] for r in results})
    reference = {(r["label"], r["seed"]): _mae(r) for r in results if r["angle_deg"] == angles[0]}
    rows: list[Row] = []
    for label in _labels(results):
        cells: list[str | Cell | None] = [label]
        for angle in angles:
            mine = [r for r in results if r["label"] == label and r["angle_deg"] == angle]
            ratios = [_ratio(_mae(r), reference.get((label, r["seed"]))) for r in mine]
            cells.append(summarize(ratios, 3))
        rows.append(cells)
    title = f"MAE over the MAE at {angles[0]:g}° of the same seed; {_about(results)}."
    return Table(title, ("model", *(f"{angle:g}°" for angle in angles)), [rows])


def input_table(results: list[Result]) -> Table:
    """The same networks on fisheye images and on equirectangular images of the same scenes, level cameras."""
    level = [r for r in results if r["angle_deg"] == 0]
    groups = []
    for label in _labels(level):
        rows: list[Row] = []
        for inputs in ("fisheye", "equirect"):
            mine = [r for r in level if r["label"] == label and r["inputs"] == inputs]
            if mine:
                rows.append([label, inputs, *_cells(mine, [(c, "paper", c, 2) for c in PAPER_COLUMNS])])
        groups.append(rows)
    title = f"Percent of N = {_number(results)}, networks trained on fisheye images alone; {_about(results)}."
    return Table(title, ("model", "images", *PAPER_COLUMNS), groups, labels=2)


def _by_angle(results: list[Result], columns: list[tuple[str, str, str, int]], title: str) -> Table:
    groups = []
    for angle in sorted({r["angle_deg"] for r in results}):
        rows: list[Row] = []
        for label in _labels(results):
            mine = [r for r in results if r["label"] == label and r["angle_deg"] == angle]
            if mine:
                rows.append([f"{angle:g}°", label, *_cells(mine, columns)])
        groups.append(rows)
    return Table(title, ("θ", "model", *(column[0] for column in columns)), groups, labels=2)


def _cells(results: list[Result], columns: Sequence[tuple[str, str, str, int]]) -> list[Cell | None]:
    return [
        summarize((r["errors"][protocol][name] for r in results), digits)
        for _, protocol, name, digits in columns
    ]


def _fisheye(results: list[Result]) -> list[Result]:
    return [r for r in results if r["inputs"] == "fisheye"]


def _labels(results: list[Result]) -> list[str]:
    return list(dict.fromkeys(r["label"] for r in results))


def _mae(result: Result) -> float | None:
    value: float | None = result["errors"]["paper"]["MAE"]
    return value


def _ratio(value: float | None, reference: float | None) -> float | None:
    return value / reference if value is not None and reference else None


def _number(results: list[Result]) -> int:
    return int(results[0]["num_hypotheses"])


def _about(results: list[Result]) -> str:
    """How many frames and seeds stand behind the numbers."""
    frames = " or ".join(str(n) for n in sorted({r["num_frames"] for r in results}))
    seeds = {r["seed"] for r in results if r["seed"] is not None}
    spread = f"mean ± standard deviation over {len(seeds)} seeds" if len(seeds) > 1 else "one seed"
    return (
        f"{frames} frames, vertices of level {results[0]['level'] - 2} that two or more cameras see, {spread}"
    )
