# SPDX-License-Identifier: Apache-2.0
"""The loop of every comparison, frames by methods, and measures: what errors it takes."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, Protocol

import torch
from torch import Tensor

from sphericalvision.icosphere import Icosphere
from sphericalvision.metrics import depth_error, depth_index_error
from sphericalvision.recipes.app.cli import track
from sphericalvision.recipes.evaluation.methods import Answer, Batch, Method, Scale
from sphericalvision.recipes.evaluation.records import Errors, Record
from sphericalvision.sweep import depth_from_index, index_from_inverse_depth

Limit = float | Literal["auto"]
"""Depth in metres up to which AbsRel and d<1.25 count; ``"auto"``: 10 for scenes indoors, 80 for all others."""

INDOORS = frozenset(("room", "hall", "corridor", "bare", "polished", "glazed", "plain", "lit"))
"""Kinds of scenes with walls all around."""


class FrameSet(Protocol):
    """Frames by name, made when they are asked for.

    Attributes:
        name: of the set, in files and tables.
        names: of all frames, in order.
        drawn: names of those whose estimates are kept for pictures.
    """

    name: str
    names: Sequence[str]
    drawn: Collection[str]

    @property
    def key(self) -> Mapping[str, Any]:
        """Settings that the frames depend on, as JSON has them."""

    def batches(self, names: Sequence[str]) -> Iterator[tuple[Sequence[str], Batch]]:
        """Some of the frames in batches, each with the names of its frames."""


class SampleFrames:
    """Samples, named by their numbers; shows its progress.

    Args:
        load: makes batches of the samples of some numbers, put together as ``collate_samples`` does.
        count: of all samples.
        name: of the set, and of its progress.
        drawn: indices of the frames that are drawn.
        key: what the frames depend on.
    """

    def __init__(
        self,
        load: Callable[[Sequence[int]], Collection[dict[str, Any]]],
        count: int,
        name: str = "evaluating",
        drawn: Sequence[int] = (),
        key: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        self.load, self.name, self.key = load, name, key
        self.names = [str(index) for index in range(count)]
        self.drawn = {str(index) for index in drawn}

    def batches(self, names: Sequence[str]) -> Iterator[tuple[Sequence[str], Batch]]:
        """The samples of some names, in batches."""
        done = 0
        loader = self.load([int(name) for name in names])
        for batch in track(loader, self.name, total=len(loader)):
            size = len(batch["valid"])
            yield names[done : done + size], batch
            done += size


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
    key = {**frames.key, **measure.key, "hypotheses": list(measure.scale)}
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
    # A frame is made once for all methods: to render it takes longer than most of them.
    remaining = [name for name in frames.names if any(name in names for names in missing.values())]
    try:
        for names, batch in frames.batches(remaining) if remaining else ():
            device = measure.directions.device
            if isinstance(batch, dict):
                batch = {
                    key: value.to(device) if hasattr(value, "to") else value for key, value in batch.items()
                }
            truth = measure.truth(batch)
            for method in methods:
                record = records[method.name]
                if not set(names) & set(missing[method.name]):
                    continue
                method.net.to(device)
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


class Measure(Protocol):
    """Errors that are taken of every method alike."""

    directions: Tensor
    """``(V, 3)`` in which estimates that are drawn are kept."""
    scale: Scale
    """The hypotheses of these estimates."""
    key: Mapping[str, Any]
    """Everything else that errors depend on. Its ``generation`` is raised whenever errors of the same frames and
    methods come out otherwise, so that old records are not taken."""

    def truth(self, batch: Batch) -> Any:
        """The truth of a batch, the same for all methods."""

    def errors(self, answer: Answer, truth: Any) -> Mapping[str, Any]:
        """Errors of each frame: nested dictionaries of tensors ``(B,)``, NaN for frames where nothing counts."""


def errors_of_frame(errors: Mapping[str, Any], frame: int) -> Errors:
    """Numbers of one frame from the tensors of a ``Measure``; None in place of NaN.

    Examples:
        >>> errors_of_frame({"all": {"MAE": torch.tensor([1.0, torch.nan])}}, 1)
        {'all': {'MAE': None}}
    """
    result: Errors = {}
    for key, value in errors.items():
        if isinstance(value, Mapping):
            result[key] = errors_of_frame(value, frame)
        else:
            error = float(value[frame])
            result[key] = None if math.isnan(error) else error
    return result


class VertexErrors:
    """The errors of papers where the truth is valid, and how many percent of the points a method keeps.

    Args:
        scale: whose percentages errors are.
        level: of the icosphere on which truth is.
        device: of the batches.
        within: ``(V,)``, False at vertices that are left out for all methods.
        max_depth: of errors in metres.
    """

    def __init__(
        self,
        scale: Scale,
        level: int,
        device: torch.device | str = "cpu",
        within: Tensor | None = None,
        max_depth: Limit = "auto",
    ) -> None:
        self.scale, self.within, self.max_depth = scale, within, max_depth
        self.key = {"generation": 2, "max_depth": max_depth}
        self.directions = Icosphere(level, device=device).vertices

    def truth(self, batch: Batch) -> Any:
        """True inverse depth, and where it counts, both ``(B, V)``; names of the frames."""
        valid = batch["valid"] if self.within is None else batch["valid"] & self.within
        return batch["inverse_depth"], valid, batch["frame"]

    def errors(self, answer: Answer, truth: Any) -> dict[str, Any]:
        """Errors of ``depth_index_error`` and ``errors_in_metres``, and percent of the points that are kept."""
        inverse_depth, counts, names = truth
        index, valid = answer.index_at(self.directions, self.scale)
        mask, target = counts & valid, index_from_inverse_depth(inverse_depth, *self.scale)
        depth = depth_from_index(index, *self.scale)
        return {
            "errors": depth_index_error(index, target, self.scale.num_hypotheses, mask),
            "metres": errors_in_metres(depth, inverse_depth.reciprocal(), mask, names, self.max_depth),
            "points": {"kept": 100 * mask.sum(1) / counts.sum(1)},
        }


def errors_in_metres(
    depth: Tensor, target: Tensor, mask: Tensor, names: Sequence[str], max_depth: Limit
) -> dict[str, Tensor]:
    """AbsRel and d<1.25 ``(B,)`` of depths ``(B, V)``, as ``depth_error`` takes them.

    Args:
        depth: estimates, metres; those beyond the limit count as the limit.
        target: true depths, metres; those beyond the limit are left out.
        mask: True where the truth counts.
        names: of the frames, those of rendered scenes beginning with their kind.
        max_depth: the limit.
    """
    frames = []
    for i, name in enumerate(names):
        usual = 10.0 if name.partition("-")[0] in INDOORS else 80.0
        limit = usual if max_depth == "auto" else max_depth
        frames.append(depth_error(depth[i, None], target[i, None], mask[i, None], max_depth=limit))
    return {key: torch.cat([errors[key] for errors in frames]) for key in ("AbsRel", "d<1.25")}


def limit_text(max_depth: Limit) -> str:
    """The limit, for titles of tables.

    Examples:
        >>> limit_text(30), limit_text("auto")
        ('within 30 m', 'within 10 m (rendered rooms) or 80 m (all else)')
    """
    return (
        f"within {'10 m (rendered rooms) or 80 m (all else)' if max_depth == 'auto' else f'{max_depth:g} m'}"
    )


def mean_errors_by_method(records: Mapping[str, Record]) -> dict[str, dict[str, float]]:
    """Mean errors of ``VertexErrors``; "kept" is the percentage of points that a method keeps, if some keep not all."""
    means = {name: record.means for name, record in records.items()}
    partial = any(
        mean["points"]["kept"] is not None and mean["points"]["kept"] < 100 for mean in means.values()
    )
    rows = {
        name: mean["errors"] | mean["metres"] | (mean["points"] if partial else {})
        for name, mean in means.items()
    }
    return {
        name: {key: math.nan if value is None else value for key, value in row.items()}
        for name, row in rows.items()
    }
