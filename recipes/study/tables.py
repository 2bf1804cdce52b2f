# SPDX-License-Identifier: Apache-2.0
"""The tables of a study, from the numbers of its runs: Markdown, CSV and LaTeX of the same cells."""

from __future__ import annotations

import csv
import io
import math
import statistics
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from sphericalvision.io.files import atomic_write
from sphericalvision.metrics import DepthIndexError

__all__ = [
    "Cell",
    "Table",
    "change_table",
    "detail_table",
    "input_table",
    "paper_table",
    "save_table",
    "summarize",
    "zone_table",
]

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


class Cell(NamedTuple):
    """Mean over seeds, sample standard deviation where there are two or more seeds, and digits to print."""

    mean: float
    spread: float | None
    digits: int = 2

    def text(self, sign: str = " ± ") -> str:
        """For reading.

        Examples:
            >>> Cell(28.688, 0.312).text(), Cell(0.5, None, 1).text()
            ('28.69 ± 0.31', '0.5')
        """
        mean = f"{self.mean:.{self.digits}f}"
        return mean if self.spread is None else f"{mean}{sign}{self.spread:.{self.digits}f}"


class Table(NamedTuple):
    """Rows in groups, such as one of each angle; a cell is text, numbers, or None for what is not measured."""

    title: str
    columns: tuple[str, ...]
    groups: list[list[list[str | Cell | None]]]

    @property
    def rows(self) -> list[list[str | Cell | None]]:
        """The rows of all groups."""
        return [row for group in self.groups for row in group]

    def markdown(self) -> str:
        """The rows, and the title below."""
        texts = sum(isinstance(cell, str) for cell in self.rows[0])
        lines = [f"| {' | '.join(self.columns)} |"]
        lines.append("|" + "---|" * texts + "---:|" * (len(self.columns) - texts))
        lines += [f"| {' | '.join(_text(cell) for cell in row)} |" for row in self.rows]
        return "\n".join([*lines, "", self.title, ""])

    def csv(self) -> str:
        """Numbers with six digits; a column of standard deviations beside each column of means."""
        numeric = [any(isinstance(row[k], Cell) for row in self.rows) for k in range(len(self.columns))]
        header = [
            h
            for name, n in zip(self.columns, numeric, strict=True)
            for h in ([name, f"{name} sd"] if n else [name])
        ]
        file = io.StringIO()
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        for row in self.rows:
            values: list[Any] = []
            for cell, n in zip(row, numeric, strict=True):
                if n:
                    values += (
                        [_exact(cell.mean), _exact(cell.spread)] if isinstance(cell, Cell) else [None, None]
                    )
                else:
                    values.append(cell)
            writer.writerow(values)
        return file.getvalue()

    def latex(self) -> str:
        """A tabular for ``booktabs``."""
        texts = sum(isinstance(cell, str) for cell in self.rows[0])
        body = "\n\\midrule\n".join(
            "\n".join(" & ".join(_latex_cell(cell) for cell in row) + " \\\\" for row in group)
            for group in self.groups
        )
        return (
            f"% {self.title}\n% \\usepackage{{booktabs}}\n"
            f"\\begin{{tabular}}{{{'l' * texts}{'r' * (len(self.columns) - texts)}}}\n\\toprule\n"
            f"{' & '.join(map(_latex, self.columns))} \\\\\n\\midrule\n{body}\n\\bottomrule\n\\end{{tabular}}\n"
        )


def summarize(values: Iterable[float | None], digits: int = 2) -> Cell | None:
    """Mean and sample standard deviation of what is known; None if nothing is, and no spread if all are the same.

    Examples:
        >>> summarize([1.0, 3.0, None])
        Cell(mean=2.0, spread=1.4142135623730951, digits=2)
    """
    known = [value for value in values if value is not None and not math.isnan(value)]
    if not known:
        return None
    spread = statistics.stdev(known) if len(set(known)) > 1 else None
    return Cell(statistics.fmean(known), spread, digits)


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
    rows: list[list[str | Cell | None]] = []
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
        rows: list[list[str | Cell | None]] = []
        for inputs in ("fisheye", "equirect"):
            mine = [r for r in level if r["label"] == label and r["inputs"] == inputs]
            if mine:
                rows.append([label, inputs, *_cells(mine, [(c, "paper", c, 2) for c in PAPER_COLUMNS])])
        groups.append(rows)
    title = f"Percent of N = {_number(results)}, networks trained on fisheye images alone; {_about(results)}."
    return Table(title, ("model", "images", *PAPER_COLUMNS), groups)


def save_table(stem: Path, table: Table) -> None:
    """Write ``.md``, ``.csv`` and ``.tex``."""
    writers: dict[str, Callable[[], str]] = {".md": table.markdown, ".csv": table.csv, ".tex": table.latex}
    for suffix, text in writers.items():
        with atomic_write(stem.with_suffix(suffix)) as temporary:
            Path(temporary).write_text(text())


def _by_angle(results: list[Result], columns: list[tuple[str, str, str, int]], title: str) -> Table:
    groups = []
    for angle in sorted({r["angle_deg"] for r in results}):
        rows: list[list[str | Cell | None]] = []
        for label in _labels(results):
            mine = [r for r in results if r["label"] == label and r["angle_deg"] == angle]
            if mine:
                rows.append([f"{angle:g}°", label, *_cells(mine, columns)])
        groups.append(rows)
    return Table(title, ("θ", "model", *(column[0] for column in columns)), groups)


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


def _exact(value: float | None) -> str | None:
    return None if value is None else f"{value:.6g}"


def _text(cell: str | Cell | None) -> str:
    return "–" if cell is None else cell if isinstance(cell, str) else cell.text()


def _latex_cell(cell: str | Cell | None) -> str:
    return "$" + cell.text(r" \pm ") + "$" if isinstance(cell, Cell) else _latex(_text(cell))


def _latex(text: str) -> str:
    r"""Text of a table as LaTeX.

    Examples:
        >>> print(_latex("15°, >1 (%)"))
        15$^\circ$, $>$1 (\%)
    """
    for plain, macro in (
        ("%", r"\%"),
        ("&", r"\&"),
        ("_", r"\_"),
        (">", "$>$"),
        ("<", "$<$"),
        ("°", r"$^\circ$"),
        ("±", r"$\pm$"),
        ("θ", r"$\theta$"),
        ("–", "--"),
    ):
        text = text.replace(plain, macro)
    return text
