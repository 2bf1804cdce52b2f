# SPDX-License-Identifier: Apache-2.0
"""Confidence interval of a mean, and sparsification: the error of the most confident points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.core import ArgumentError

DRAWS = 2000
"""Samples with replacement of a bootstrap."""


class Interval(NamedTuple):
    """A mean, and its bounds."""

    mean: float
    low: float
    high: float


def bootstrap_interval(values: Sequence[float] | Float[Tensor, " n"]) -> Interval:
    """Return the mean of independent values, such as one a scene, and its bootstrap interval of 95 % by percentiles.

    Args:
        values: one or more; NaN are left out.

    Returns:
        All three NaN without a value. With infinite values the mean and at least the upper bound are infinite.

    References:
        Efron (1979), "Bootstrap methods: another look at the jackknife".

    Examples:
        >>> mean, low, high = bootstrap_interval([1.0, 2.0, 3.0, 2.0])
        >>> mean, low < mean < high
        (2.0, True)
    """
    samples = torch.as_tensor(values, dtype=torch.float64).flatten()
    samples = samples[~samples.isnan()]
    if not len(samples):
        return Interval(torch.nan, torch.nan, torch.nan)
    generator = torch.Generator().manual_seed(0)
    chosen = torch.randint(len(samples), (DRAWS, len(samples)), generator=generator)
    bounds = samples.cpu()[chosen].mean(1).quantile(torch.tensor([0.025, 0.975], dtype=torch.float64))
    low, high = bounds.nan_to_num(nan=torch.inf, posinf=torch.inf).tolist()  # between infinities it finds NaN
    return Interval(samples.mean().item(), low, high)


def error_of_surest(
    error: Float[Tensor, "B V"],
    confidence: Float[Tensor, "B V"],
    shares: Sequence[float],
    mask: Bool[Tensor, "B V"] | None = None,
) -> Float[Tensor, "B shares"]:
    """Return the mean error of the surest points of each image, for several shares of them.

    Args:
        error: ``(B, V)``; NaN is an infinite error.
        confidence: ``(B, V)`` on any scale; larger is surer, NaN is least sure.
        shares: of the points that count, in (0, 1]; 1 is all of them.
        mask: ``(B, V)``, True where a point counts; everywhere when not given.

    Returns:
        ``(B, len(shares))``; NaN for an image without such a point.

    Raises:
        ArgumentError: a share outside (0, 1].

    References:
        Ilg et al. (2018), "Uncertainty estimates and multi-hypotheses networks for optical flow": sparsification.

    Examples:
        >>> error_of_surest(torch.tensor([[1.0, 3.0]]), torch.tensor([[0.9, 0.2]]), (0.5, 1.0))
        tensor([[1., 2.]])
    """
    if not shares or not all(0 < share <= 1 for share in shares):
        raise ArgumentError(f"shares: expected one or more in (0, 1], got {list(shares)}")
    counts = torch.ones_like(error, dtype=torch.bool) if mask is None else mask.bool()
    error, confidence = (
        error.nan_to_num(torch.inf, torch.inf),
        confidence.nan_to_num(-torch.inf, torch.inf, -torch.inf),
    )
    rows = []
    for errors, sure, valid in zip(error, confidence, counts, strict=True):
        order = sure[valid].argsort(descending=True)
        ranked = errors[valid][order]
        sizes = [max(1, round(share * len(ranked))) for share in shares]
        rows.append(torch.stack([ranked[:k].mean() for k in sizes]))
    return torch.stack(rows)
