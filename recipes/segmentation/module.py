# SPDX-License-Identifier: Apache-2.0
"""Segmentation on the sphere as a Lightning module: network, cross entropy, and mean IoU in each orientation."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler
from torchmetrics import Metric

from sphericalvision.core import ArgumentError
from sphericalvision.models.segmenter import SphereSegmenter
from sphericalvision.recipes.segmentation.rooms import ORIENTATIONS
from sphericalvision.recipes.training.module import TrainingModule

__all__ = ["MeanIoU", "SegmentationModule"]


class MeanIoU(Metric):
    """Mean over the classes that occur of intersection over union, in percent, places weighted by solid angle.

    Args:
        num_classes: number of classes.
        weights: ``(*grid)`` of places.

    Examples:
        >>> metric = MeanIoU(2, torch.tensor([1.0, 1.0, 2.0]))
        >>> metric.update(torch.tensor([[0, 1, 1]]), torch.tensor([[0, 0, 1]]))
        >>> round(metric.compute().item(), 1)  # one of two, two of three
        58.3
    """

    table: Tensor
    weights: Tensor

    def __init__(self, num_classes: int, weights: Float[Tensor, "*grid"]) -> None:
        super().__init__()
        self.num_classes = num_classes
        self.register_buffer("weights", weights.flatten().double(), persistent=False)
        self.add_state("table", torch.zeros(num_classes, num_classes).double(), dist_reduce_fx="sum")

    def update(self, found: Int[Tensor, "*places"], label: Int[Tensor, "*places"]) -> None:
        """Count places; those labelled -1 are left out."""
        known = label.flatten() >= 0
        places = (label.flatten() * self.num_classes + found.flatten())[known]
        weights = self.weights.repeat(len(label))[known]
        counts = torch.bincount(places, weights, self.num_classes**2)
        self.table += counts.view(self.num_classes, -1).to(self.table)

    def compute(self) -> Float[Tensor, ""]:
        """Percent."""
        both = self.table.diagonal()
        either = self.table.sum(0) + self.table.sum(1) - both
        return 100 * (both / either)[self.table.sum(1) > 0].mean()


class SegmentationModule(TrainingModule):
    """A segmenter on the sphere, validated and tested in every orientation.

    Args:
        net: the network; ``net.num_classes`` classes.
        loss: of logits and labels, of which -1 does not count.
        optimizer: makes the optimiser of parameters.
        scheduler: makes the schedule of an optimiser.
        monitor: the validated value that chooses the best checkpoint.
        mode: "min" or "max", its best direction.
        seed: of each training step, with its number.
    """

    metric_names = tuple(ORIENTATIONS)
    unit = "mean IoU in percent"

    def __init__(
        self,
        net: SphereSegmenter,
        loss: Callable[[Tensor, Tensor], Tensor],
        optimizer: Callable[..., Optimizer],
        scheduler: Callable[[Optimizer], LRScheduler],
        monitor: str = "val/upright",
        mode: str = "max",
        seed: int = 0,
    ) -> None:
        super().__init__(net, loss, optimizer, scheduler, monitor, mode, seed)
        weights = net.grid.solid_angles
        self.scores = torch.nn.ModuleDict({name: MeanIoU(net.num_classes, weights) for name in ORIENTATIONS})

    def initialize(self, weights: str | Path) -> None:
        """Not offered.

        Raises:
            ArgumentError: always.
        """
        raise ArgumentError(
            "init_weights: experiment=segmentation starts from nothing; leave init_weights out"
        )

    def forward(self, values: Tensor) -> Tensor:
        """Logits ``(B, num_classes, *grid.shape)`` of values ``(B, 3, *grid.shape)``."""
        return self.net(values)  # type: ignore[no-any-return]

    def training_step(self, batch: dict[str, Any], batch_idx: int) -> Tensor:
        """The loss of one batch."""
        loss: Tensor = self.loss(self(batch["values"]), batch["label"])
        self.log("train/loss", loss, prog_bar=True, batch_size=len(batch["label"]))
        return loss

    def validation_step(self, batch: dict[str, Any], batch_idx: int, dataloader_idx: int = 0) -> None:
        """Compare; loaders are in the order of ``ORIENTATIONS``."""
        score = cast(MeanIoU, self.scores[tuple(ORIENTATIONS)[dataloader_idx]])
        score.update(self(batch["values"]).argmax(1), batch["label"])

    def on_validation_epoch_end(self) -> None:
        """Log ``val/upright`` and so on."""
        self._log_scores("val")

    def test_step(self, batch: dict[str, Any], batch_idx: int, dataloader_idx: int = 0) -> None:
        """Compare; loaders are in the order of ``ORIENTATIONS``."""
        self.validation_step(batch, batch_idx, dataloader_idx)

    def on_test_epoch_end(self) -> None:
        """Log ``test/upright`` and so on."""
        self._log_scores("test")

    def _log_scores(self, split: str) -> None:
        for name in ORIENTATIONS:
            score = cast(MeanIoU, self.scores[name])
            self.log(f"{split}/{name}", score.compute().float(), prog_bar=True)
            score.reset()
