# SPDX-License-Identifier: Apache-2.0
"""Segmentation on the sphere as a Lightning module: network, cross entropy, and mean IoU in each orientation."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from sphericalvision.core import ArgumentError
from sphericalvision.metrics import SolidAngleIoU
from sphericalvision.models.segmenter import SphereSegmenter
from sphericalvision.recipes.segmentation.rooms import ORIENTATIONS
from sphericalvision.recipes.training.module import TrainingModule

__all__ = ["SegmentationModule"]


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
        self.scores = nn.ModuleDict(
            {name: SolidAngleIoU(net.grid, net.num_classes, ignore_index=-1) for name in ORIENTATIONS}
        )

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
        score = cast(SolidAngleIoU, self.scores[tuple(ORIENTATIONS)[dataloader_idx]])
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
            score = cast(SolidAngleIoU, self.scores[name])
            self.log(f"{split}/{name}", 100 * score.compute()["mIoU"], prog_bar=True)
            score.reset()
