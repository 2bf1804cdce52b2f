# SPDX-License-Identifier: Apache-2.0
"""The tables of a study, from the numbers of its runs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sphericalvision.metrics import DepthIndexError
from sphericalvision.recipes.evaluation.tables import Cell, Row, Table, summarize

__all__ = ["Result", "study_tables"]

Result = dict[str, Any]
"""What the JSON of one model, seed and view holds: ``label``, ``inputs``, ``angle_deg``, ``seed``, ``errors``."""

Column = tuple[str, str, str, int]
"""Heading, protocol, name and digits."""

COLUMNS: dict[str, tuple[Column, ...]] = {
    "table": tuple((name, "paper", name, 2) for name in DepthIndexError.error_names),
    "details": (
        ("AbsRel", "depth", "AbsRel", 3),
        ("RMSE (m)", "depth", "RMSE", 2),
        ("d<1.25", "depth", "d<1.25", 3),
        ("MAE by solid angle", "solid_angle", "MAE", 2),
        ("OmniMVS protocol MAE", "omnimvs", "MAE", 2),
        ("MAE at seams", "seam", "MAE", 2),
        ("MAE off seams", "off_seam", "MAE", 2),
        ("MAE, nothing left out", "all", "MAE", 2),
        ("left out (%)", "points", "left_out", 1),
    ),
    "where": (
        ("above 30°", "above", "MAE", 2),
        ("within 30°", "around", "MAE", 2),
        ("below −30°", "below", "MAE", 2),
        ("2 cameras", "two", "MAE", 2),
        ("3 cameras", "three", "MAE", 2),
        ("4 or more", "four", "MAE", 2),
    ),
}
"""Columns of tables that have a row for each angle and model."""


def study_tables(results: list[Result]) -> dict[str, Table]:
    """All tables by the names of their files; that of inputs where there are equirectangular ones.

    * ``table``: the paper's, ``>1 >3 >5 MAE RMS`` of each model at each angle;
    * ``details``: the other protocols;
    * ``change``: MAE at each angle over the MAE of the same seed with level cameras, 1 is unmoved;
    * ``where``: MAE by latitude and by the number of cameras that see a point: where a model suffers from the angle;
    * ``inputs``: the same networks on fisheye images and on equirectangular images of the same scenes.
    """
    fisheye = [r for r in results if r["inputs"] == "fisheye"]
    shares = {r["angle_deg"]: r["errors"]["points"]["left_out"] for r in fisheye}
    left_out = ", ".join(f"{share:.1f} % at {angle:g}°" for angle, share in sorted(shares.items()))
    number, about = f"N = {results[0]['num_hypotheses']}", _about(results)
    titles = {
        "table": f"Percent of {number}; {about}. Left out, as fewer cameras see it: {left_out}.",
        "details": f"MAE in percent of {number}, but for that of the OmniMVS protocol (panorama within 45° of the "
        f"horizon, N = 192); depths up to 100 m; {about}. Left out: points that fewer than two cameras see.",
        "where": f"MAE in percent of {number} by latitude and by cameras that see a point; {about}.",
    }
    tables = {name: _by_angle(fisheye, COLUMNS[name], title) for name, title in titles.items()}
    tables["change"] = _change(fisheye, about)
    if len(fisheye) < len(results):
        title = f"Percent of {number}, networks trained on fisheye images alone; {about}."
        tables["inputs"] = _by_input([r for r in results if r["angle_deg"] == 0], title)
    return tables


def _change(results: list[Result], about: str) -> Table:
    angles = sorted({r["angle_deg"] for r in results})
    level = {(r["label"], r["seed"]): _mae(r) for r in results if r["angle_deg"] == angles[0]}
    rows: list[Row] = []
    for label in _labels(results):
        ratios: dict[float, list[float | None]] = {angle: [] for angle in angles}
        for r in results:
            if r["label"] == label:
                ratios[r["angle_deg"]].append(_ratio(_mae(r), level.get((label, r["seed"]))))
        rows.append([label, *(summarize(values, 3) for values in ratios.values())])
    title = f"MAE over the MAE at {angles[0]:g}° of the same seed; {about}."
    return Table(title, ("model", *(f"{angle:g}°" for angle in angles)), [rows])


def _by_input(results: list[Result], title: str) -> Table:
    groups = []
    for label in _labels(results):
        rows: list[Row] = []
        for inputs in ("fisheye", "equirect"):
            mine = [r for r in results if r["label"] == label and r["inputs"] == inputs]
            if mine:
                rows.append([label, inputs, *_cells(mine, COLUMNS["table"])])
        groups.append(rows)
    return Table(title, ("model", "images", *DepthIndexError.error_names), groups, labels=2)


def _by_angle(results: list[Result], columns: Sequence[Column], title: str) -> Table:
    groups = []
    for angle in sorted({r["angle_deg"] for r in results}):
        rows: list[Row] = []
        for label in _labels(results):
            mine = [r for r in results if r["label"] == label and r["angle_deg"] == angle]
            if mine:
                rows.append([f"{angle:g}°", label, *_cells(mine, columns)])
        groups.append(rows)
    return Table(title, ("θ", "model", *(column[0] for column in columns)), groups, labels=2)


def _cells(results: list[Result], columns: Sequence[Column]) -> list[Cell | None]:
    return [
        summarize((r["errors"][protocol][name] for r in results), digits)
        for _, protocol, name, digits in columns
    ]


def _labels(results: list[Result]) -> list[str]:
    return list(dict.fromkeys(r["label"] for r in results))


def _mae(result: Result) -> float | None:
    value: float | None = result["errors"]["paper"]["MAE"]
    return value


def _ratio(value: float | None, reference: float | None) -> float | None:
    return value / reference if value is not None and reference else None


def _about(results: list[Result]) -> str:
    """How many frames and seeds stand behind the numbers."""
    frames = " or ".join(str(n) for n in sorted({r["num_frames"] for r in results}))
    seeds = {r["seed"] for r in results if r["seed"] is not None}
    spread = f"mean ± standard deviation over {len(seeds)} seeds" if len(seeds) > 1 else "one seed"
    return (
        f"{frames} frames, vertices of level {results[0]['level'] - 2} that two or more cameras see, {spread}"
    )
