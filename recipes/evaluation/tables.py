# SPDX-License-Identifier: Apache-2.0
"""Tables: estimators of the hypothesis index, the paper's errors of each, printed and saved."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Iterable, Mapping, Sized
from pathlib import Path
from typing import Any, NamedTuple

import torch
from rich.progress import track
from torch import Tensor

from sphericalvision.core import ArgumentError
from sphericalvision.io.files import write_bytes
from sphericalvision.metrics import DepthIndexError
from sphericalvision.models import DepthNetwork
from sphericalvision.recipes.app.cli import print_table
from sphericalvision.sweep import index_from_inverse_depth, photo_consistency, semi_global_sweep

__all__ = [
    "Estimator",
    "Row",
    "constant_estimators",
    "evaluate",
    "index_target",
    "print_rows",
    "save_rows",
    "semi_global_estimator",
    "sweep_estimator",
]

Batch = dict[str, Any]
Estimator = Callable[[Batch], Tensor]
"""Takes a batch, gives the hypothesis index ``(B, V)``, NaN where it does not say."""


class Row(NamedTuple):
    """One line of a table: what was measured, and its errors by name."""

    name: str
    values: Mapping[str, float]


def index_target(batch: Batch, net: DepthNetwork) -> Tensor:
    """True hypothesis index ``(B, V)`` in the hypotheses of ``net``; not rounded."""
    return index_from_inverse_depth(batch["inverse_depth"], net.num_hypotheses, net.min_depth)


@torch.inference_mode()
def evaluate(
    estimators: Mapping[str, Estimator],
    loader: Iterable[Batch],
    net: DepthNetwork,
    within: Tensor | None = None,
) -> list[Row]:
    """Errors of several estimators on the same batches, in the hypotheses of ``net``; shows its progress.

    ``within`` ``(V,)`` leaves out all points where it is False. Where an estimator leaves out points, the column "kept"
    says how many percent of them it kept.
    """
    device = net.device
    number = net.num_hypotheses
    metrics = {name: DepthIndexError(number).to(device) for name in estimators}
    kept: dict[str, list[Tensor]] = {name: [] for name in estimators}
    for batch in _progress(loader, "evaluating"):
        batch = {key: value.to(device) if hasattr(value, "to") else value for key, value in batch.items()}
        target = index_target(batch, net)
        valid = batch["valid"] if within is None else batch["valid"] & within.to(device)
        for name, estimator in estimators.items():
            index = estimator(batch)
            said = valid & ~index.isnan()
            metrics[name].update(index, target, said)
            kept[name] += [*(100 * said.sum(-1) / valid.sum(-1))]
    shares = {name: float(torch.stack(values).nanmean()) for name, values in kept.items() if values}
    partial = any(share < 100 for share in shares.values())
    return [
        Row(
            name,
            {key: float(value) for key, value in metric.compute().items()}
            | ({"kept": shares[name]} if partial else {}),
        )
        for name, metric in metrics.items()
    ]


def constant_estimators(loader: Iterable[Batch], net: DepthNetwork) -> dict[str, Estimator]:
    """The best constants of the training set for the mean absolute error: a depth map, and a single depth.

    Both are medians of the true index: over the frames for each vertex, and over everything.

    Raises:
        ArgumentError: there is no valid ground truth.
    """
    device = net.device
    targets = [
        index_target(batch, net).where(batch["valid"], torch.nan)
        for batch in _progress(loader, "training depths")
    ]
    truth = torch.cat(targets) if targets else torch.full((1, 1), torch.nan)
    scalar = truth.nanmedian().to(device)
    if scalar.isnan():
        raise ArgumentError(
            "baselines: the training set has no valid depth to take the median of; check data.*"
        )
    per_vertex = truth.nanmedian(0).values.to(device)
    per_vertex = per_vertex.where(~per_vertex.isnan(), scalar)
    return {
        "constant depth map": lambda batch: per_vertex.expand_as(batch["inverse_depth"]),
        "constant depth": lambda batch: scalar.expand_as(batch["inverse_depth"]),
    }


def sweep_estimator(net: DepthNetwork) -> Estimator:
    """The training-free photo-consistency sweep with the hypotheses of ``net``."""
    number, min_depth = net.num_hypotheses, net.min_depth

    def estimate(batch: Batch) -> Tensor:
        return photo_consistency(
            batch["images"], batch["rig"], number, min_depth, seen=batch.get("seen")
        ).index

    return estimate


def semi_global_estimator(net: DepthNetwork) -> Estimator:
    """The training-free sweep with semi-global smoothing, with the hypotheses of ``net``."""
    number, min_depth = net.num_hypotheses, net.min_depth

    def estimate(batch: Batch) -> Tensor:
        return semi_global_sweep(
            batch["images"], batch["rig"], number, min_depth, seen=batch.get("seen")
        ).index

    return estimate


def print_rows(title: str, rows: list[Row]) -> None:
    """Print a table; the columns are those of the first row."""
    names = list(rows[0].values)
    print_table(
        title, ["", *names], [[row.name, *(f"{row.values[key]:.2f}" for key in names)] for row in rows]
    )


def save_rows(stem: Path, rows: list[Row]) -> None:
    """Write a table as ``.md``, ``.json`` and ``.csv``; the columns are those of the first row."""
    names = list(rows[0].values)
    lines = ["| | " + " | ".join(names) + " |", "|---" + "|---:" * len(names) + "|"]
    lines += ["| " + " | ".join([row.name, *(f"{row.values[k]:.2f}" for k in names)]) + " |" for row in rows]
    table = io.StringIO(newline="")
    writer = csv.writer(table)
    writer.writerow(["name", *names])
    writer.writerows([row.name, *(row.values[key] for key in names)] for row in rows)
    values = json.dumps({row.name: dict(row.values) for row in rows}, indent=2)
    contents = {".md": "\n".join(lines) + "\n", ".json": values + "\n", ".csv": table.getvalue()}
    for suffix, content in contents.items():
        write_bytes(stem.with_suffix(suffix), content.encode())


def _progress(loader: Iterable[Batch], label: str) -> Iterable[Batch]:
    return track(loader, label, total=len(loader) if isinstance(loader, Sized) else None)
