# SPDX-License-Identifier: Apache-2.0
"""The results of a comparison: errors of methods on sets of frames, and the tables of them."""

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from sphericalvision.metrics.spread import bootstrap_interval
from sphericalvision.recipes.evaluation.methods import Method
from sphericalvision.recipes.evaluation.records import Record
from sphericalvision.recipes.evaluation.tables import Cell, Row, Table, summarize

Column = tuple[str, str, int]
"""A heading, the path of an error (its keys with blanks between them), and its digits."""


class Results(NamedTuple):
    """All measurements of a comparison.

    Attributes:
        methods: in the order of tables; those of one label are a model with several seeds.
        records: name of a set of frames -> name of a method -> its record.
    """

    methods: Sequence[Method]
    records: Mapping[str, Mapping[str, Record]]

    @property
    def labels(self) -> list[str]:
        """The models, each once."""
        return list(dict.fromkeys(method.label for method in self.methods))

    def errors(self, method: Method, path: str, *sets: str) -> list[float]:
        """One number of every frame of some sets that has it."""
        numbers = []
        for frame in (frame for name in sets for frame in self.records[name][method.name].frames.values()):
            value: Any = frame
            for key in path.split():
                value = value.get(key) if isinstance(value, Mapping) else None
            if value is not None:
                numbers.append(float(value))
        return numbers

    def means(self, label: str, path: str, *sets: str) -> list[float]:
        """The mean over the frames of some sets, for each seed of a model; NaN where no frame has that number."""
        seeds = [self.errors(method, path, *sets) for method in self.methods if method.label == label]
        return [statistics.fmean(values) if values else math.nan for values in seeds]

    def cell(self, label: str, path: str, digits: int, *sets: str) -> Cell | None:
        """The mean over the frames of some sets, and its standard deviation over the seeds of a model."""
        return summarize(self.means(label, path, *sets), digits)

    def by_set(self, title: str, heading: str, sets: Mapping[str, str], columns: Sequence[Column]) -> Table:
        """A row for each set of frames and model; the keys of ``sets`` stand below ``heading``."""
        rows: list[Row] = [
            [text, label, *(self.cell(label, path, digits, name) for _, path, digits in columns)]
            for text, name in sets.items()
            for label in self.labels
        ]
        return Table(title, (heading, "model", *(column[0] for column in columns)), rows, labels=2)

    def by_method(self, title: str, heading: str, path: str, digits: int) -> Table:
        """A row for each set of frames, a column for each method: mean, and its interval of 95 % over frames.

        The best of a row is bold: the least error, or the largest fraction within a factor.
        """
        best = max if path.rpartition(" ")[2].startswith("d<") else min
        rows: list[Row] = []
        for name in self.records:
            intervals = [bootstrap_interval(self.errors(method, path, name)) for method in self.methods]
            means = [interval.mean for interval in intervals if not math.isnan(interval.mean)]
            winner = best(means) if len(means) > 1 else math.nan
            cells = [
                None if math.isnan(mean) else Cell(mean, None, digits, (low, high), mean == winner)
                for mean, low, high in intervals
            ]
            rows.append([name, *cells])
        frames = max(len(record.frames) for records in self.records.values() for record in records.values())
        about = (
            f"{title}: mean over {frames} frames, and in brackets 95 % of the bootstrap means over frames."
        )
        return Table(about, (heading, *(method.label for method in self.methods)), rows)

    def against(self, title: str, path: str, sets: Mapping[str, str]) -> Table:
        """A row for each model: its error on each set, and the ratio to the error of the same seed on the first set."""
        first, *others = sets
        rows: list[Row] = []
        for label in self.labels:
            means = {text: self.means(label, path, name) for text, name in sets.items()}
            ratios = [
                [
                    error / base if base else math.nan
                    for error, base in zip(means[o], means[first], strict=True)
                ]
                for o in others
            ]
            rows.append([label, *map(summarize, means.values()), *(summarize(ratio, 3) for ratio in ratios)])
        return Table(title, ("model", *sets, *(f"{other} / {first}" for other in others)), rows)

    def plain(self) -> list[dict[str, Any]]:
        """Everything for JSON, a dictionary for each set of frames and method."""
        return [
            {
                "frames": name,
                "method": method.name,
                "label": method.label,
                "seed": method.seed,
                "num_frames": len(records[method.name].frames),
                "errors": records[method.name].means,
                "cost": records[method.name].cost,
            }
            for name, records in self.records.items()
            for method in self.methods
        ]
