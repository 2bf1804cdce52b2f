# SPDX-License-Identifier: Apache-2.0
"""The loop of every comparison, frames by methods, and measures: what errors it takes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from sphericalvision.icosphere import Icosphere
from sphericalvision.metrics import depth_index_error
from sphericalvision.recipes.evaluation.frames import Batch, FrameSet
from sphericalvision.recipes.evaluation.methods import Answer, Method, Scale
from sphericalvision.recipes.evaluation.records import Errors, Record
from sphericalvision.sweep import index_from_inverse_depth

__all__ = ["Measure", "VertexErrors", "errors_of_frame", "evaluate", "mean_errors_by_method"]


@torch.no_grad()
def evaluate(
    methods: Sequence[Method],
    frames: FrameSet,
    measure: Measure,
    folder: Path | None = None,
    count_cost: bool = False,
) -> dict[str, Record]:
    """Take the errors of methods on frames, of each method those that its record lacks; all see the same batches.

    Args:
        methods: with names that differ.
        frames: what is estimated.
        measure: what errors.
        folder: where records are kept, ``records/FRAMES/METHOD.json``; nothing is without one.
        count_cost: whether to count what a frame costs each method, and the time that it takes.

    Returns:
        Name of a method -> its record, of these frames alone.
    """
    key = {**frames.key, "generation": measure.generation, "hypotheses": list(measure.scale)}
    home = None if folder is None else folder / "records" / frames.name
    records = {
        method.name: Record(home and home / f"{method.name}.json", {**key, "method": method.identity})
        for method in methods
    }
    missing = {
        method.name: [
            name for name in frames.names if not records[method.name].has(name, name in frames.drawn)
        ]
        for method in methods
    }
    remaining = [name for name in frames.names if any(name in names for names in missing.values())]
    try:
        for names, batch in frames.batches(remaining) if remaining else ():
            batch = _on(batch, measure.directions.device)
            truth = measure.truth(batch)
            for method in methods:
                record = records[method.name]
                if not set(names) & set(missing[method.name]):
                    continue
                answer = method(batch)
                errors = measure.errors(answer, truth)
                for frame, name in enumerate(names):
                    frame_errors = errors_of_frame(errors, frame)
                    if count_cost:
                        frame_errors["seconds"] = answer.seconds
                    drawn = None
                    if name in frames.drawn:
                        index, valid = answer.index_at(measure.directions, measure.scale)
                        drawn = index[frame].where(valid[frame], math.nan)
                    record.add(name, frame_errors, drawn)
                if count_cost and record.cost is None:
                    record.cost = method.cost(batch)
                record.save(at_once=False)
    finally:
        for method in methods:
            if missing[method.name]:
                records[method.name].save()
    return {name: record.only(frames.names) for name, record in records.items()}


def _on(batch: Batch, device: torch.device) -> Batch:
    """A batch on a device."""
    if not isinstance(batch, dict):
        return batch
    return {key: value.to(device) if hasattr(value, "to") else value for key, value in batch.items()}


class Measure(Protocol):
    """Errors that are taken of every method alike."""

    directions: Tensor
    """``(V, 3)`` in which estimates that are drawn are kept."""
    scale: Scale
    """In whose hypotheses."""
    generation: int
    """Raised whenever errors of the same frames and methods come out otherwise, so that old records are not taken."""

    def truth(self, batch: Batch) -> Any:
        """What is right for a batch, the same for all methods."""

    def errors(self, answer: Answer, truth: Any) -> Mapping[str, Any]:
        """Errors of each frame: nested dictionaries of tensors ``(B,)``, NaN for frames where nothing counts."""


def errors_of_frame(errors: Mapping[str, Any], frame: int) -> Errors:
    """One frame of what a ``Measure`` says, as numbers; None in place of NaN.

    Examples:
        >>> errors_of_frame({"all": {"MAE": torch.tensor([1.0, torch.nan])}}, 1)
        {'all': {'MAE': None}}
    """
    result: Errors = {}
    for key, value in errors.items():
        if isinstance(value, Mapping):
            result[key] = errors_of_frame(value, frame)
        else:
            number = float(value[frame])
            result[key] = None if math.isnan(number) else number
    return result


class VertexErrors:
    """The errors of papers where the truth is valid, and how many percent of the points a method keeps.

    Args:
        scale: whose percentages errors are.
        level: of the icosphere on which truth is.
        device: of the batches.
        within: ``(V,)``, False at vertices that are left out for all methods.
    """

    generation = 1

    def __init__(
        self, scale: Scale, level: int, device: torch.device | str = "cpu", within: Tensor | None = None
    ) -> None:
        self.scale, self.within = scale, within
        self.directions = Icosphere(level, device=device).vertices

    def truth(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """The true index, not rounded, and where it counts, both ``(B, V)``."""
        valid = batch["valid"] if self.within is None else batch["valid"] & self.within
        return index_from_inverse_depth(batch["inverse_depth"], *self.scale), valid

    def errors(self, answer: Answer, truth: tuple[Tensor, Tensor]) -> dict[str, Any]:
        """``errors``: of ``depth_index_error``; ``points``: percent that are kept."""
        target, counts = truth
        index, valid = answer.index_at(self.directions, self.scale)
        share = 100 * (counts & valid).sum(1) / counts.sum(1)
        errors = depth_index_error(index, target, self.scale.num_hypotheses, counts & valid)
        return {"errors": errors, "points": {"kept": share}}


def mean_errors_by_method(records: Mapping[str, Record]) -> dict[str, dict[str, float]]:
    """Mean errors of ``VertexErrors``; "kept" says how many percent of the points some method keeps, if not all do."""
    means = {name: record.means for name, record in records.items()}
    partial = any(
        mean["points"]["kept"] is not None and mean["points"]["kept"] < 100 for mean in means.values()
    )
    rows = {name: mean["errors"] | (mean["points"] if partial else {}) for name, mean in means.items()}
    return {
        name: {key: math.nan if value is None else value for key, value in row.items()}
        for name, row in rows.items()
    }
