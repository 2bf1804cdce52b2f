# SPDX-License-Identifier: Apache-2.0
"""Shared by metrics: weights of points that sum to one in each image, and weighted means."""

from __future__ import annotations

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from sphericalvision.core import ArgumentError
from sphericalvision.geometry.directions import holds


def point_weights(
    pred: Shaped[Tensor, "B V"],
    target: Shaped[Tensor, "B V"],
    mask: Shaped[Tensor, "B V"] | None,
    weights: Shaped[Tensor, " ..."] | None,
) -> Float[Tensor, "B V"]:
    """Return float64 weights ``(B, V)``, zero outside the mask and where the truth is not finite.

    They sum to one in each image, and are NaN in an image without any.

    Raises:
        ArgumentError: if a weight that counts is negative or not finite.
    """
    fractions = torch.ones(pred.shape, dtype=torch.float64, device=pred.device)
    if weights is not None:
        fractions = fractions * weights
    counts = target.isfinite() if mask is None else mask.bool() & target.isfinite()
    fractions = fractions.masked_fill(~counts, 0)
    if weights is not None and not holds(fractions.isfinite() & (fractions >= 0)):
        raise ArgumentError("weights: expected finite numbers, 0 or more, wherever the truth counts")
    return fractions / fractions.sum(1, keepdim=True)


def absolute_error(pred: Shaped[Tensor, "B V"], target: Shaped[Tensor, "B V"]) -> Float[Tensor, "B V"]:
    """Return ``|pred - target|`` in float64, infinite where it is NaN: a NaN is wrong, never right."""
    return (pred.double() - target.double()).abs().nan_to_num(nan=torch.inf, posinf=torch.inf)


def weighted_mean(values: Shaped[Tensor, "B V"], fractions: Float[Tensor, "B V"]) -> Float[Tensor, " B"]:
    """Return the weighted mean ``(B,)``; values without weight are ignored, NaN included."""
    return torch.where(fractions == 0, 0.0, values * fractions).sum(1)
