# SPDX-License-Identifier: Apache-2.0
"""Robust means over views: the weights of pixels, lower where a view disagrees with the others."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras import Camera, EquirectangularCamera
from sphericalvision.geometry import angle_from_axis
from sphericalvision.sphere.resampling.supersampling import pixel_solid_angles

_FAINTEST = 1e-4  # weight at the border of a view, of that at its center
_ROUNDS = 2  # of weighting by agreement: the first mean may still lie between two surfaces


def pixel_weights(camera: Camera) -> Float[Tensor, "h w"]:
    """Weight of each pixel of a view: its solid angle, times its distance from the border of what is seen."""
    pixels = camera.pixel_grid(torch.float64)
    directions, valid = camera.unproject(pixels)
    solid = torch.where(valid, pixel_solid_angles(camera).view(camera.image_size), 0.0)
    if isinstance(camera, EquirectangularCamera):
        inside = torch.ones_like(solid)
    else:
        height, width = camera.image_size
        center = pixels.new_tensor([(width - 1) / 2, (height - 1) / 2])
        # Falls to zero at the image's border and at the largest angle, so that no seam is visible where a view ends.
        inside = (1 - (pixels - center).abs() / (center + 0.5)).amin(-1)
        inside = inside.minimum(1 - angle_from_axis(directions) / camera.max_angle)
    # Never quite zero: a pixel at the border still counts where no other view has one.
    return (solid / solid.max() * inside).clamp_min(_FAINTEST)


def robust_mean(
    values: Float[Tensor, " n *values"], weights: Float[Tensor, " n *weights"], dims: int
) -> tuple[Float[Tensor, "*values"], Float[Tensor, "*weights"]]:
    """Mean over views, those that disagree counting less, and the weighted deviation from it.

    Args:
        values: ``(n, *b, c, *target)``.
        weights: ``(n, *b, 1, *target)``, 0 where a view shows nothing.
        dims: dimensions of the target.
    """
    trust = weights
    for _ in range(_ROUNDS):
        mean, squared = mean_and_squares(values, trust, dims)
        trust = weights * cauchy_weights(squared, weights, dims)
    mean, squared = mean_and_squares(values, trust, dims)
    return mean, _mean(squared, trust).detach().sqrt()


def mean_and_squares(values: Tensor, weights: Tensor, dims: int) -> tuple[Tensor, Tensor]:
    """Mean over views, and squared deviations ``(n, *b, 1, *target)`` from it, averaged over channels."""
    mean = _mean(values, weights)
    # Gradients flow through the mean alone: weights that follow them would move towards outliers.
    return mean, (values - mean).detach().square().mean(-1 - dims, keepdim=True)


def cauchy_weights(squared: Tensor, weights: Tensor, dims: int) -> Tensor:
    """Cauchy's weights 1 / (1 + r² / s²) of squared deviations r², with their mean s where views overlap.

    There is one s for each sample of the batch. A single view has the deviation 0, which would make s too small.
    """
    overlaps = weights * ((weights > 0).sum(0) > 1)
    sums = (0, *range(-1 - dims, 0))
    tiny = torch.finfo(squared.dtype).tiny  # views that agree exactly have s = 0
    deviation = (squared.sqrt() * overlaps).sum(sums, keepdim=True)
    scale = deviation / overlaps.sum(sums, keepdim=True).clamp_min(tiny)
    return 1 / (1 + squared / scale.square().clamp_min(tiny))


def _mean(values: Tensor, weights: Tensor) -> Tensor:
    total = weights.sum(0)
    return (values * weights).sum(0) / torch.where(total > 0, total, 1.0)
