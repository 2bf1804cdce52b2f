# SPDX-License-Identifier: Apache-2.0
"""Errors of hypothesis indices and of depths in metres, per image and then averaged over images."""

from __future__ import annotations

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from sphericalvision.core import ArgumentError, check_counts
from sphericalvision.metrics.images import absolute_error, point_weights, weighted_mean
from sphericalvision.shapes import check_shapes


@check_shapes
def depth_index_error(
    pred_index: Float[Tensor, "B V"],
    target_index: Float[Tensor, "B V"],
    num_hypotheses: int,
    mask: Shaped[Tensor, "B V"] | None = None,
    weights: Float[Tensor, " V"] | Float[Tensor, "B V"] | None = None,
) -> dict[str, Float[Tensor, " B"]]:
    """Return the errors of hypothesis indices for each image, in percent of the number of hypotheses.

    With ``e = 100 * |pred - target| / N``: ``">1"``, ``">3"`` and ``">5"`` are the percentages of points with
    e strictly above, ``"MAE"`` is the mean of e and ``"RMS"`` the root of the mean of its square. The numbers
    scale with ``(N - 1) / N``: compare only at one N.

    Args:
        pred_index: ``(B, V)`` predicted indices; NaN is an infinite error.
        target_index: ``(B, V)`` true indices, not rounded; points that are not finite are left out.
        num_hypotheses: N.
        mask: ``(B, V)``, True where the truth counts; everywhere when not given.
        weights: ``(V,)`` or ``(B, V)``, for instance the solid angles of a grid; equal when not given.

    Returns:
        The five errors ``(B,)``; NaN for an image without a valid point.

    Raises:
        ArgumentError: if ``num_hypotheses`` is not positive, or a weight that counts is negative or not finite.

    References:
        Won, Ryu and Lim (2019), "OmniMVS: end-to-end learning for omnidirectional stereo matching", section
        4.

    Examples:
        >>> errors = depth_index_error(torch.tensor([[1.0, 2.0]]), torch.tensor([[1.0, 2.8]]),
        ...     num_hypotheses=20)
        >>> {name: round(value.item(), 3) for name, value in errors.items()}
        {'>1': 50.0, '>3': 50.0, '>5': 0.0, 'MAE': 2.0, 'RMS': 2.828}
    """
    check_counts(num_hypotheses=num_hypotheses)
    fractions = point_weights(pred_index, target_index, mask, weights)
    error = absolute_error(pred_index, target_index) * (100 / num_hypotheses)
    above = {
        f">{threshold}": weighted_mean(100.0 * (error > threshold), fractions) for threshold in (1, 3, 5)
    }
    return above | {
        "MAE": weighted_mean(error, fractions),
        "RMS": weighted_mean(error.square(), fractions).sqrt(),
    }


@check_shapes
def depth_error(
    pred_depth: Float[Tensor, "B V"],
    target_depth: Float[Tensor, "B V"],
    mask: Shaped[Tensor, "B V"] | None = None,
    weights: Float[Tensor, " V"] | Float[Tensor, "B V"] | None = None,
    max_depth: float = 100.0,
) -> dict[str, Float[Tensor, " B"]]:
    """Return the errors of depths in metres for each image.

    ``"AbsRel"`` is the mean of ``|pred - target| / target``, ``"RMSE"`` is in metres, ``"d<1.25"`` is the
    share (0 to 1) of points with ``max(pred / target, target / pred) < 1.25``.

    Args:
        pred_depth: ``(B, V)`` in metres along the ray; larger values count as ``max_depth``, NaN is an infinite
            error, and values that are not positive are never within 1.25.
        target_depth: ``(B, V)``; points beyond ``max_depth``, at infinity, NaN or not positive are left out.
        mask: ``(B, V)``, True where the truth counts; everywhere when not given.
        weights: ``(V,)`` or ``(B, V)``, for instance the solid angles of a grid; equal when not given.
        max_depth: in metres.

    Returns:
        The three errors ``(B,)``; NaN for an image without a valid point.

    Raises:
        ArgumentError: if ``max_depth`` is not positive, or a weight that counts is negative or not finite.

    References:
        Eigen, Puhrsch and Fergus (2014), "Depth map prediction from a single image using a multi-scale deep
        network".

    Examples:
        >>> errors = depth_error(torch.tensor([[2.0, 3.0]]), torch.tensor([[1.0, 3.0]]))
        >>> {name: round(value.item(), 3) for name, value in errors.items()}
        {'AbsRel': 0.5, 'RMSE': 0.707, 'd<1.25': 0.5}
    """
    if not max_depth > 0:
        raise ArgumentError(f"max_depth: expected a positive number of metres, got {max_depth!r}")
    in_range = (target_depth > 0) & (target_depth <= max_depth)
    fractions = point_weights(
        pred_depth, target_depth, in_range if mask is None else in_range & mask.bool(), weights
    )
    pred = pred_depth.clamp(max=max_depth).to(fractions.dtype)
    target = target_depth.to(fractions.dtype)
    error = absolute_error(pred, target)
    right = (pred > 0) & (torch.maximum(pred / target, target / pred) < 1.25)
    return {
        "AbsRel": weighted_mean(error / target, fractions),
        "RMSE": weighted_mean(error.square(), fractions).sqrt(),
        "d<1.25": weighted_mean(right.to(fractions.dtype), fractions),
    }
