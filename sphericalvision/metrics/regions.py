# SPDX-License-Identifier: Apache-2.0
"""Errors by region of the sphere: near seams and elsewhere, where cameras overlap or not."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from jaxtyping import Float, Shaped
from torch import Tensor
from torchmetrics import Metric, MetricCollection

from sphericalvision.core import ArgumentError, ShapeError


class ByRegion(Metric):
    """A metric of this package in each of several regions, and everywhere.

    Args:
        metric: ``DepthIndexError``, ``DepthError`` or another whose ``update`` takes prediction, truth and mask;
            it is copied for each region.
        regions: name -> ``(V,)`` bool, the places that belong to a region; they may overlap.

    ``update`` takes the arguments of the metric's. ``compute`` returns every error as ``"name"`` everywhere and
    ``"region/name"`` in a region, each averaged over the images with valid points there.

    Raises:
        ArgumentError: if there are no regions.
        ShapeError: if a region does not fit the values.

    Examples:
        >>> import torch
        >>> from sphericalvision.metrics import DepthIndexError
        >>> metric = ByRegion(DepthIndexError(100), {"seam": torch.tensor([True, False])})
        >>> metric.update(torch.tensor([[3.0, 1.0]]), torch.zeros(1, 2))
        >>> metric.compute()["MAE"].item(), metric.compute()["seam/MAE"].item()
        (2.0, 3.0)
    """

    full_state_update = False

    def __init__(
        self, metric: Metric, regions: Mapping[str, Shaped[Tensor, "*grid"]], **kwargs: object
    ) -> None:
        super().__init__(**kwargs)
        if not regions:
            raise ArgumentError("regions: expected at least one, got none")
        self.everywhere = metric.clone()
        self.by_region = MetricCollection({name: metric.clone() for name in regions}, compute_groups=False)
        for name, region in regions.items():
            self.register_buffer(f"region_{name}", region.bool(), persistent=False)

    def update(
        self,
        pred: Float[Tensor, "*#batch"],
        target: Float[Tensor, "*#batch"],
        mask: Shaped[Tensor, "*#batch"] | None = None,
        **options: Tensor,
    ) -> None:
        """Add a batch: ``(B, V)`` predictions and truth, an optional ``(B, V)`` mask, and the metric's options."""
        for _, metric, inside in self._parts(pred, mask):
            metric.update(pred, target, inside, **options)

    def forward(
        self,
        pred: Float[Tensor, "*#batch"],
        target: Float[Tensor, "*#batch"],
        mask: Shaped[Tensor, "*#batch"] | None = None,
        **options: Tensor,
    ) -> dict[str, Float[Tensor, " ..."]]:
        """Add a batch as ``update`` does, and return its errors alone."""
        self._computed, self._update_count = None, self._update_count + 1
        return {
            f"{prefix}{error}": value
            for prefix, metric, inside in self._parts(pred, mask)
            for error, value in metric(pred, target, inside, **options).items()
        }

    def merge_state(self, incoming_state: dict[str, Any] | Metric) -> None:
        """Add the images of another ``ByRegion`` of the same regions."""
        if (
            not isinstance(incoming_state, ByRegion)
            or incoming_state.by_region.keys() != self.by_region.keys()
        ):
            raise ArgumentError(f"incoming_state: expected a ByRegion of the regions {list(self.by_region)}")
        self._computed, self._update_count = None, self._update_count + incoming_state._update_count
        self.everywhere.merge_state(incoming_state.everywhere)
        for name, metric in self.by_region.items():
            metric.merge_state(incoming_state.by_region[name])

    def _parts(self, pred: Tensor, mask: Tensor | None) -> Iterator[tuple[str, Metric, Tensor | None]]:
        """Prefix of the names of errors, metric and mask, everywhere and in each region."""
        yield "", self.everywhere, mask
        for name, metric in self.by_region.items():
            region = getattr(self, f"region_{name}")
            if region.shape != pred.shape[1:]:
                raise ShapeError(
                    f"prediction: expected (B, {', '.join(map(str, region.shape))}) as the region {name!r}, got "
                    f"{tuple(pred.shape)}"
                )
            inside = region.expand(pred.shape)
            yield f"{name}/", metric, inside if mask is None else inside & mask.bool()

    def compute(self) -> dict[str, Float[Tensor, " ..."]]:
        """Return the errors everywhere and in each region."""
        values: dict[str, Tensor] = dict(self.everywhere.compute())
        for name, metric in self.by_region.items():
            values |= {f"{name}/{error}": value for error, value in metric.compute().items()}
        return values

    def reset(self) -> None:
        """Forget all images."""
        super().reset()
        self.everywhere.reset()
        self.by_region.reset()
