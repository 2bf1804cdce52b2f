# SPDX-License-Identifier: Apache-2.0
"""Where a fit starts: shapes that are tried on a unit image, and linear least squares."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.fitting.model import FittedModel, Samples

__all__ = ["PLANE_REACH", "shape_grid", "solve_linear", "with_shapes"]

PLANE_REACH = math.radians(80)
"""A model of the image plane is fitted up to here, unless the original ends before."""


def with_shapes(
    model: FittedModel, samples: Samples, shapes: Iterable[Sequence[float]]
) -> list[Float[Tensor, " p"]]:
    """The two best vectors of models that scale and shift a unit image, which numbers beyond that shape.

    For each shape, focal lengths and principal point follow by linear least squares.
    """
    tried = []
    for numbers in shapes:
        shape = samples.pixels.new_tensor(list(numbers))
        unit = torch.cat((shape.new_ones(2), shape.new_zeros(2), shape))
        plane, valid = model.pixels(unit, samples.directions)
        valid = valid & plane.isfinite().all(-1)
        if valid.sum() < 3:
            continue
        x, y = plane[valid], samples.pixels[valid]
        centred = x - x.mean(0)
        focal_length = (centred * (y - y.mean(0))).sum(0) / (centred * centred).sum(0)
        center = y.mean(0) - focal_length * x.mean(0)
        rms = float((focal_length * x + center - y).square().mean().sqrt())
        tried.append((int((~valid).sum()), rms, torch.cat((focal_length, center, shape))))
    return [vector for *_, vector in sorted(tried, key=lambda entry: entry[:2])[:2]]


def shape_grid(*axes: Sequence[float]) -> Callable[[FittedModel, Samples], list[Tensor]]:
    """Starts from all combinations of shape numbers, with zeros behind them."""

    def starts(model: FittedModel, samples: Samples) -> list[Tensor]:
        zeros = (0.0,) * (sum(size or 1 for size in model.sizes.values()) - 4 - len(axes))
        return with_shapes(model, samples, [(*shape, *zeros) for shape in itertools.product(*axes)])

    return starts


def solve_linear(columns: Float[Tensor, "m k"], target: Float[Tensor, " m"]) -> Float[Tensor, " k"]:
    """Linear least squares with columns of unit length."""
    length = columns.norm(dim=0)
    solution = torch.linalg.lstsq(columns / length, target.unsqueeze(-1), driver="gelsd").solution
    return solution.squeeze(-1) / length
