# SPDX-License-Identifier: Apache-2.0
"""Losses on hypothesis indices, and losses on any grid weighted by solid angle."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Num, Shaped
from torch import Tensor

from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.geometry.directions import in_single_precision
from sphericalvision.shapes import check_shapes


@check_shapes
def depth_index_huber(
    pred_index: Float[Tensor, " B *grid"],
    target_index: Float[Tensor, " B *grid"],
    mask: Shaped[Tensor, " B *grid"] | None = None,
    delta: float = 1.0,
    weights: Float[Tensor, " *grid"] | Float[Tensor, " B *grid"] | None = None,
) -> Float[Tensor, ""]:
    """Return the mean Huber loss of hypothesis indices over the points of a mask, then over the samples.

    Args:
        pred_index: ``(B, V)`` predicted indices, 0 to N - 1, as from ``soft_argmax``.
        target_index: ``(B, V)`` indices of the ground truth, not rounded.
        mask: ``(B, V)``, True where the ground truth counts; everywhere when not given. Values outside the mask
            have no influence, NaN included.
        delta: index difference at which the loss turns from quadratic to linear.
        weights: ``(V,)`` or ``(B, V)``, for instance the solid angles of a grid; equal when not given. All may be of
            any grid, ``(B, h, w)`` and ``(h, w)``.

    Returns:
        A scalar in float32 at least, the mean of what each sample has alone: as with ``accumulate_grad_batches``, a
        sample with few known points counts as much as one with many. A sample with an empty mask has 0, with zero
        gradients.

    References:
        Huber (1964), "Robust estimation of a location parameter".

    Examples:
        >>> depth_index_huber(torch.tensor([[0.0, 3.0]]), torch.tensor([[1.0, 0.0]]))  # (0.5 + 2.5) / 2
        tensor(1.5000)
    """
    if not delta > 0:
        raise ArgumentError(f"delta: expected an index difference above 0, got {delta!r}")
    pred_index, target_index = in_single_precision(pred_index), in_single_precision(target_index)
    if mask is not None:
        mask = mask.bool()
        pred_index, target_index = pred_index.where(mask, 0), target_index.where(mask, 0)
    losses = F.huber_loss(pred_index, target_index, delta=delta, reduction="none")
    point_weights = torch.ones_like(losses) if weights is None else weights.to(losses).expand_as(losses)
    point_weights = point_weights if mask is None else point_weights.where(mask, 0.0)
    return mean_of_samples(losses, point_weights)


def mean_of_samples(
    values: Float[Tensor, " B *grid"], weights: Num[Tensor, " B *grid"] | Bool[Tensor, " B *grid"]
) -> Float[Tensor, ""]:
    """Return the mean over the samples of each one's weighted mean; 0 for a sample without weight.

    Examples:
        >>> mean_of_samples(torch.tensor([[1.0, 3.0], [5.0, 7.0]]), torch.tensor([[1.0, 1.0], [0.0, 2.0]]))
        tensor(4.5000)
    """
    point_weights = weights.to(values).flatten(1)
    return _ratio((values.flatten(1) * point_weights).sum(1), point_weights.sum(1)).mean()


@check_shapes
def solid_angle_mean(
    values: Float[Tensor, "*values"],
    solid_angles: Float[Tensor, "*grid"],
    mask: Shaped[Tensor, " ..."] | None = None,
) -> Float[Tensor, "*batch"]:
    """Return the mean of values over the sphere, or over the part of it that a mask leaves.

    Any loss at each place becomes one in which every part of the sphere counts by its size:
    ``solid_angle_mean((pred - target).abs(), grid.solid_angles, mask).mean()``, or of labels
    ``solid_angle_mean(F.cross_entropy(logits, labels, reduction="none"), grid.solid_angles).mean()``.

    Args:
        values: ``(*b, *shape)`` on a grid.
        solid_angles: ``(*shape)`` of that grid, ``grid.solid_angles``.
        mask: of the values' shape or one that broadcasts to it, True where they count. Values outside have no
            influence, and get no gradient, NaN included.

    Returns:
        ``(*b)`` in float32 at least; 0, with zero gradients, where the mask is empty.

    Raises:
        ShapeError: if the values do not lie on the grid, or the mask does not fit them.
        ArgumentError: if the values are integers.

    Examples:
        >>> from sphericalvision.sphere import Equirectangular
        >>> grid = Equirectangular(64, 128)
        >>> height = -grid.directions[..., 1]
        >>> solid_angle_mean(height.abs(), grid.solid_angles)  # the mean over pixels is 0.64
        tensor(0.5002)
    """
    values = in_single_precision(values)
    dims = solid_angles.ndim
    if values.ndim < dims or values.shape[values.ndim - dims :] != solid_angles.shape:
        size = ", ".join(map(str, solid_angles.shape))
        raise ShapeError(f"values: expected shape (*, {size}) as the solid angles, got {tuple(values.shape)}")
    point_weights = solid_angles.to(values).expand_as(values)
    if mask is not None:
        try:
            counts = mask.bool().expand_as(values)
        except RuntimeError:
            raise ShapeError(
                f"mask: expected a shape that broadcasts to {tuple(values.shape)}, got {tuple(mask.shape)}"
            ) from None
        point_weights, values = point_weights.where(counts, 0.0), values.where(counts, 0.0)
    grid = tuple(range(-dims, 0))
    return _ratio((values * point_weights).sum(grid), point_weights.sum(grid))


def _ratio(total: Tensor, weight: Tensor) -> Tensor:
    """Return total / weight, and 0 where there is no weight."""
    return total / weight.where(weight > 0, torch.ones_like(weight))
