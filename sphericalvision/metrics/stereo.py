# SPDX-License-Identifier: Apache-2.0
"""The metrics of Helvipad: errors of depth or disparity, and how well the two edges of a panorama meet."""

from __future__ import annotations

from jaxtyping import Float, Shaped
from torch import Tensor

from sphericalvision.metrics.images import absolute_error, point_weights, weighted_mean
from sphericalvision.shapes import check_shapes


@check_shapes
def stereo_error(
    pred: Float[Tensor, "B V"],
    target: Float[Tensor, "B V"],
    mask: Shaped[Tensor, "B V"] | None = None,
    weights: Float[Tensor, " V"] | Float[Tensor, "B V"] | None = None,
) -> dict[str, Float[Tensor, " B"]]:
    """Return MAE, RMSE and MARE of depth or disparity for each image, in the unit of the input.

    With e = pred − target: the means of |e| and of |e| / target, and the root of the mean of e².

    Args:
        pred: ``(B, V)``; NaN is an infinite error.
        target: ``(B, V)``, finite and above 0 where it counts.
        mask: ``(B, V)``, True where the truth counts; where it is finite and above 0 when not given.
        weights: ``(V,)`` or ``(B, V)``, for instance the solid angles of a grid; equal when not given.

    Returns:
        The three errors ``(B,)``; NaN for an image without a valid point.

    Raises:
        ArgumentError: if a weight that counts is negative or not finite.

    References:
        M. Zayene et al., "Helvipad: a real-world dataset for omnidirectional stereo depth estimation", CVPR 2025.

    Examples:
        >>> import torch
        >>> errors = stereo_error(torch.tensor([[2.0, 3.0]]), torch.tensor([[1.0, 3.0]]))
        >>> {name: round(value.item(), 3) for name, value in errors.items()}
        {'MAE': 0.5, 'RMSE': 0.707, 'MARE': 0.5}
    """
    counts = target > 0 if mask is None else mask.bool() & (target > 0)
    fractions = point_weights(pred, target, counts, weights)
    error = absolute_error(pred, target)
    return {
        "MAE": weighted_mean(error, fractions),
        "RMSE": weighted_mean(error.square(), fractions).sqrt(),
        "MARE": weighted_mean(error / target, fractions),
    }


@check_shapes
def left_right_error(
    pred: Float[Tensor, "B h w"], target: Float[Tensor, "B h w"], mask: Shaped[Tensor, "B h w"] | None = None
) -> dict[str, Float[Tensor, " B"]]:
    """Return LRCE, the left-right consistency error, for each image.

    The mean over rows of |(target at the first column − at the last) − (the same of pred)|, of rows where the
    target is known at both.

    Args:
        pred: ``(B, h, w)``; NaN in a first or last column is an infinite error.
        target: ``(B, h, w)``, finite and above 0 where it counts.
        mask: ``(B, h, w)``, True where the truth counts; where it is finite and above 0 when not given.

    Returns:
        ``{"LRCE": (B,)}``; NaN for an image without such a row.

    References:
        M. Zayene et al., "Helvipad: a real-world dataset for omnidirectional stereo depth estimation", CVPR 2025.

    Examples:
        >>> import torch
        >>> left_right_error(torch.tensor([[[1.0, 5.0, 3.0]]]), torch.tensor([[[1.0, 5.0, 2.0]]]))["LRCE"].item()
        1.0
    """
    counts = target > 0 if mask is None else mask.bool() & (target > 0)
    steps = [values.double()[..., 0] - values.double()[..., -1] for values in (target, pred)]
    fractions = point_weights(steps[1], steps[0], counts[..., 0] & counts[..., -1], None)
    return {"LRCE": weighted_mean(absolute_error(steps[1], steps[0]), fractions)}
