# SPDX-License-Identifier: Apache-2.0
"""What errors are taken of an answer; the commonest ones, those of papers at the vertices of an icosphere."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Protocol

import torch
from torch import Tensor

from sphericalvision.icosphere import Icosphere
from sphericalvision.metrics import depth_index_error
from sphericalvision.recipes.evaluation.frames import Batch
from sphericalvision.recipes.evaluation.methods import Answer, Scale
from sphericalvision.recipes.evaluation.records import Errors, Record
from sphericalvision.sweep import index_from_inverse_depth

__all__ = ["Measure", "VertexErrors", "errors_of_frame", "mean_errors_by_method"]


class Measure(Protocol):
    """Errors that are taken of every method alike."""

    directions: Tensor
    """``(V, 3)`` in which estimates that are drawn are kept."""
    scale: Scale
    """In whose hypotheses."""

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
    found: Errors = {}
    for key, value in errors.items():
        if isinstance(value, Mapping):
            found[key] = errors_of_frame(value, frame)
        else:
            number = float(value[frame])
            found[key] = None if math.isnan(number) else number
    return found


class VertexErrors:
    """The errors of papers where the truth is valid, and how many percent of the points a method keeps.

    Args:
        scale: whose percentages errors are.
        level: of the icosphere on which truth is.
        device: of the batches.
        within: ``(V,)``, False at vertices that are left out for all methods.
    """

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
        index, known = answer.index_at(self.directions, self.scale)
        kept = 100 * (counts & known).sum(1) / counts.sum(1)
        errors = depth_index_error(index, target, self.scale.num_hypotheses, counts & known)
        return {"errors": errors, "points": {"kept": kept}}


def mean_errors_by_method(records: Mapping[str, Record]) -> dict[str, dict[str, float]]:
    """Mean errors of ``VertexErrors``; "kept" says how many percent of the points some method keeps, if not all do."""
    means = {name: record.means for name, record in records.items()}
    partial = any(
        mean["points"]["kept"] is not None and mean["points"]["kept"] < 100 for mean in means.values()
    )
    known = {name: mean["errors"] | (mean["points"] if partial else {}) for name, mean in means.items()}
    return {
        name: {key: math.nan if value is None else value for key, value in row.items()}
        for name, row in known.items()
    }
