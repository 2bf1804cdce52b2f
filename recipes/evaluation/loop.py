# SPDX-License-Identifier: Apache-2.0
"""The loop of every comparison: frames, methods, errors, records."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch

from sphericalvision.recipes.evaluation.frames import Batch, FrameSet
from sphericalvision.recipes.evaluation.measures import Measure, errors_of_frame
from sphericalvision.recipes.evaluation.methods import Method
from sphericalvision.recipes.evaluation.records import Record

__all__ = ["evaluate"]


@torch.no_grad()
def evaluate(
    methods: Sequence[Method],
    frames: FrameSet,
    measure: Measure,
    records: Mapping[str, Record] | None = None,
    count_cost: bool = False,
) -> dict[str, Record]:
    """Take the errors of methods on frames, of each method those that its record lacks; all see the same batches.

    Args:
        methods: with names that differ.
        frames: what is estimated.
        measure: what errors.
        records: name of a method -> its record, which is added to; new ones when not given.
        count_cost: whether to count what a frame costs each method, and the time that it takes.

    Returns:
        The records.
    """
    records = {method.name: Record() for method in methods} if records is None else dict(records)
    missing = {
        method.name: [
            name for name in frames.names if not records[method.name].has(name, name in frames.drawn)
        ]
        for method in methods
    }
    wanted = set().union(*missing.values())
    try:
        for names, batch in frames.batches([name for name in frames.names if name in wanted]):
            batch = _on(batch, measure.directions.device)
            truth = measure.truth(batch)
            for method in methods:
                record = records[method.name]
                if not set(names) & set(missing[method.name]):
                    continue
                answer = method(batch)
                errors = measure.errors(answer, truth)
                for frame, name in enumerate(names):
                    found = errors_of_frame(errors, frame)
                    if count_cost:
                        found["seconds"] = answer.seconds
                    drawn = None
                    if name in frames.drawn:
                        index, known = answer.index_at(measure.directions, measure.scale)
                        drawn = index[frame].where(known[frame], math.nan)
                    record.add(name, found, drawn)
                if count_cost and record.cost is None:
                    record.cost = method.cost(batch)
                record.save(at_once=False)
    finally:
        for method in methods:
            if missing[method.name]:
                records[method.name].save()
    return records


def _on(batch: Batch, device: torch.device) -> Batch:
    """A batch on a device."""
    if not isinstance(batch, dict):
        return batch
    return {key: value.to(device) if hasattr(value, "to") else value for key, value in batch.items()}
