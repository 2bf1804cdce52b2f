# SPDX-License-Identifier: Apache-2.0
"""What metrics share: weights of points that sum to one in each image, and means over images."""

from __future__ import annotations

from abc import abstractmethod

import torch
from jaxtyping import Float, Shaped
from torch import Tensor
from torchmetrics import Metric

from sphericalvision.core import ArgumentError
from sphericalvision.geometry.directions import holds


def point_weights(
    pred: Shaped[Tensor, "B V"],
    target: Shaped[Tensor, "B V"],
    mask: Shaped[Tensor, "B V"] | None,
    weights: Shaped[Tensor, " ..."] | None,
) -> Float[Tensor, "B V"]:
    """Return float64 weights ``(B, V)``: zero outside the mask and where the truth is not finite.

    They are one in total per image, NaN in an image without any.

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
    """Return ``|pred - target|`` in float64; infinite where it is NaN: what is no number is wrong, never right."""
    return (pred.double() - target.double()).abs().nan_to_num(nan=torch.inf, posinf=torch.inf)


def weighted_mean(values: Shaped[Tensor, "B V"], fractions: Float[Tensor, "B V"]) -> Float[Tensor, " B"]:
    """Return the weighted mean ``(B,)``; values without weight are ignored, NaN included."""
    return torch.where(fractions == 0, 0.0, values * fractions).sum(1)


class MeanOverImages(Metric):
    """Means over images of errors known for each image; states are sums, so processes add up."""

    full_state_update = False
    error_names: tuple[str, ...]
    sums: Tensor
    num_images: Tensor

    def __init__(self, **kwargs: object) -> None:
        super().__init__(**kwargs)
        zeros = torch.zeros(len(self.error_names), dtype=torch.float64)
        self.add_state("sums", default=zeros, dist_reduce_fx="sum")
        self.add_state("num_images", default=torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    @abstractmethod
    def _errors(
        self, pred: Tensor, target: Tensor, mask: Tensor | None, weights: Tensor | None
    ) -> dict[str, Tensor]:
        """Return the errors of each image ``(B,)`` by name; NaN for an image that does not count."""

    def update(
        self,
        pred: Float[Tensor, " B *grid"],
        target: Float[Tensor, " B *grid"],
        mask: Shaped[Tensor, " B *grid"] | None = None,
        weights: Float[Tensor, "*grid"] | Float[Tensor, " B *grid"] | None = None,
    ) -> None:
        """Add a batch: ``(B, V)`` predictions and truth, an optional ``(B, V)`` mask and ``(V,)`` weights."""
        errors = self._errors(pred, target, mask, weights)
        table = torch.stack([errors[name] for name in self.error_names])
        counts = ~table.isnan().all(0)
        self.sums += table[:, counts].sum(1)
        self.num_images += counts.sum()

    def compute(self) -> dict[str, Float[Tensor, ""]]:
        """Return the means over all images with at least one valid point, by name; NaN if there was none."""
        means = (self.sums / self.num_images).float()
        return dict(zip(self.error_names, means, strict=True))
