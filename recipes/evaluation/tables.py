# SPDX-License-Identifier: Apache-2.0
"""Tables: the same cells as Markdown, CSV, LaTeX, HTML and JSON, and on the console."""

from __future__ import annotations

import csv
import html
import io
import json
import math
import re
import statistics
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from sphericalvision.io.files import write_bytes
from sphericalvision.recipes.app.cli import print_table
from sphericalvision.recipes.evaluation.records import write_json


class Cell(NamedTuple):
    """A mean and its uncertainty.

    Attributes:
        mean: the number.
        spread: standard deviation, where there are several values.
        digits: to print.
        interval: in which the mean lies.
        best: whether it is the best of its row, to be printed in bold.
    """

    mean: float
    spread: float | None = None
    digits: int = 2
    interval: tuple[float, float] | None = None
    best: bool = False

    def text(self) -> str:
        """Format for reading.

        Examples:
            >>> Cell(28.688, 0.312).text(), Cell(0.5, digits=1).text()
            ('28.69 ± 0.31', '0.5')
            >>> Cell(2.0, interval=(1.5, 2.25), best=True).text()
            '**2.00** (1.50–2.25)'
        """
        text = f"**{self.mean:.{self.digits}f}**" if self.best else f"{self.mean:.{self.digits}f}"
        if self.spread is not None:
            text += f" ± {self.spread:.{self.digits}f}"
        if self.interval is not None:
            text += f" ({'–'.join(f'{bound:.{self.digits}f}' for bound in self.interval)})"
        return text


Content = str | float | Cell | None
"""Content of a cell: a text, a number (printed with two digits), a mean, or None for what is not measured."""

Row = Sequence[Content]

STYLE = "body{font:14px sans-serif} td,th{padding:2px 8px;text-align:right} td:first-child{text-align:left}"


class Table(NamedTuple):
    """Rows of cells below headings.

    Attributes:
        title: what the numbers are.
        columns: headings.
        rows: of cells.
        labels: number of columns that name a row, aligned left; numbers are aligned right.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Row]
    labels: int = 1

    def texts(self) -> list[list[str]]:
        """All cells for reading."""
        return [[_text(cell) for cell in row] for row in self.rows]

    def markdown(self) -> str:
        """The rows, and the title below."""
        lines = [f"| {' | '.join(row)} |" for row in ([*self.columns], *self.texts())]
        lines[0] = lines[0].replace("|  |", "| |")
        lines.insert(1, "|" + "---|" * self.labels + "---:|" * (len(self.columns) - self.labels))
        return "\n".join([*lines, *(["", self.title] if self.title else []), ""])

    def csv(self) -> str:
        """Numbers with six digits; standard deviations have a column next to their means."""
        means = [[cell.mean if isinstance(cell, Cell) else cell for cell in row] for row in self.rows]
        spreads = [[cell.spread if isinstance(cell, Cell) else None for cell in row] for row in self.rows]
        file = io.StringIO()
        writer = csv.writer(file, lineterminator="\n")
        columns: list[list[Any]] = []
        for k, name in enumerate([self.columns[0] or "name", *self.columns[1:]]):
            columns.append([name, *(row[k] for row in means)])
            if any(row[k] is not None for row in spreads):
                columns.append([f"{name} sd", *(row[k] for row in spreads)])
        for row in zip(*columns, strict=True):
            writer.writerow([f"{cell:.6g}" if isinstance(cell, float) else cell for cell in row])
        return file.getvalue()

    def latex(self) -> str:
        r"""The rows as a ``tabular`` with the rules of the package booktabs, and the title as a comment.

        Examples:
            >>> print(error_table("percent of N", {"net_a": {"MAE": 1.5}}).latex())
            % percent of N
            \begin{tabular}{lr}
            \toprule
             & MAE \\
            \midrule
            net\_a & 1.50 \\
            \bottomrule
            \end{tabular}
            <BLANKLINE>
        """
        columns = "l" * self.labels + "r" * (len(self.columns) - self.labels)
        header, *rows = (
            " & ".join(map(_escape_latex, row)) + r" \\" for row in ([*self.columns], *self.texts())
        )
        title = [f"% {self.title}"] if self.title else []
        lines = [*title, rf"\begin{{tabular}}{{{columns}}}", r"\toprule", header, r"\midrule", *rows]
        return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])

    def html(self) -> str:
        """A paragraph with the title, and the table."""
        lines = [f"<th>{'</th><th>'.join(map(html.escape, self.columns))}</th>"]
        lines += [f"<td>{'</td><td>'.join(map(html.escape, row))}</td>" for row in self.texts()]
        body = re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", "\n".join(f"<tr>{line}</tr>" for line in lines))
        return f"<p>{html.escape(self.title)}</p>\n<table>{body}</table>"

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> Table:
        """The table whose ``_asdict()`` was written as JSON.

        Examples:
            >>> Table.of({"title": "m", "columns": ["", "MAE"], "rows": [["net", [1.5, None, 1]]], "labels": 1}).texts()
            [['net', '1.5']]
        """
        rows: list[Row] = [
            [Cell(*cell) if isinstance(cell, list) else cell for cell in row] for row in content["rows"]
        ]
        return cls(**{**content, "rows": rows})

    def print(self) -> None:
        """On the console."""
        print_table(self.title, list(self.columns), self.texts())

    def save(self, stem: Path, *suffixes: str) -> None:
        """Write ``.md``, ``.csv`` or ``.tex``."""
        writers = {".md": self.markdown, ".csv": self.csv, ".tex": self.latex}
        for suffix in suffixes:
            write_bytes(stem.with_name(stem.name + suffix), writers[suffix]().encode())


def error_table(title: str, errors: Mapping[str, Mapping[str, float]]) -> Table:
    """A row of errors for each name; the columns are those of the first. AbsRel and d<1.25 have three digits.

    Examples:
        >>> print(error_table("percent of N", {"net": {"MAE": 1.5, "RMS": 2.25}}).markdown())
        | | MAE | RMS |
        |---|---:|---:|
        | net | 1.50 | 2.25 |
        <BLANKLINE>
        percent of N
        <BLANKLINE>
    """
    columns = list(next(iter(errors.values())))
    digits = {"AbsRel": 3, "d<1.25": 3}
    rows: list[Row] = [
        [name, *(Cell(row[key], digits=digits.get(key, 2)) for key in columns)]
        for name, row in errors.items()
    ]
    return Table(title, ("", *columns), rows)


def save_errors(stem: Path, title: str, errors: Mapping[str, Mapping[str, float]]) -> Table:
    """Print a table of errors and write it as ``.md``, ``.csv``, ``.tex`` and ``.json``."""
    table = error_table(title, errors)
    table.print()
    table.save(stem, ".md", ".csv", ".tex")
    write_json(stem.with_suffix(".json"), errors)
    return table


def save_report(
    folder: Path,
    name: str,
    title: str,
    tables: Mapping[str, Table],
    pictures: Mapping[str, str],
    content: Any,
) -> None:
    """Write tables and pictures below their headings, ``<name>.md`` and ``index.html``; print the first table.

    Args:
        folder: of both, of each table as ``.md`` and ``.csv``, of all as ``tables.json``, and of ``<name>.json``.
        name: of the Markdown.
        title: of the page.
        tables: heading -> table.
        pictures: heading -> file in the folder.
        content: of the JSON.
    """
    sections = [(heading, table.markdown().rstrip(), table.html()) for heading, table in tables.items()]
    for heading, file in pictures.items():
        image = f'<img src="{html.escape(quote(file))}" loading="lazy" style="max-width:100%">'
        sections.append((heading, f"![{heading}](<{file}>)", image))
    text = [f"# {title}", *(f"## {heading}\n\n{body}" for heading, body, _ in sections)]
    head = f"<!doctype html><meta charset=utf-8><title>{html.escape(title)}</title>\n<style>{STYLE}</style>"
    page = [head, *(f"<h2>{html.escape(heading)}</h2>\n{body}" for heading, _, body in sections)]
    for heading, table in tables.items():
        table.save(folder / heading.replace(" ", "_"), ".md", ".csv")
    lines = [f"{json.dumps(heading)}: {json.dumps(table._asdict())}" for heading, table in tables.items()]
    write_bytes(folder / "tables.json", ("{\n" + ",\n".join(lines) + "\n}\n").encode())
    write_json(folder / f"{name}.json", content)
    write_bytes(folder / f"{name}.md", ("\n\n".join(text) + "\n").encode())
    write_bytes(folder / "index.html", ("\n".join(page) + "\n").encode())
    next(iter(tables.values())).print()
    print(f"Results are in {folder}: {name}.md, {name}.json, index.html")


def summarize(values: Iterable[float | None], digits: int = 2) -> Cell | None:
    """Mean and sample standard deviation of the numbers; None without any, and no spread if all are the same.

    Examples:
        >>> summarize([1.0, 3.0, None])
        Cell(mean=2.0, spread=1.4142135623730951, digits=2, interval=None, best=False)
    """
    numbers = [value for value in values if value is not None and not math.isnan(value)]
    if not numbers:
        return None
    return Cell(
        statistics.fmean(numbers), statistics.stdev(numbers) if len(set(numbers)) > 1 else None, digits
    )


def _escape_latex(text: str) -> str:
    """Escape special characters; bold and the signs of cells become commands."""
    signs = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    signs |= {"±": r"$\pm$", "–": "--", ">": r"$>$", "<": r"$<$", "°": r"$^\circ$"}
    signs |= {sign: "\\" + sign for sign in "&%$#_{}"}
    plain = "".join(signs.get(sign, sign) for sign in text)
    return re.sub(r"\*\*(.+?)\*\*", r"\\textbf{\1}", plain)


def _text(cell: Content) -> str:
    if isinstance(cell, Cell):
        return cell.text()
    return "–" if cell is None else cell if isinstance(cell, str) else f"{cell:.2f}"
