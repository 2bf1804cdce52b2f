# SPDX-License-Identifier: Apache-2.0
"""Segmentation on the sphere as a Lightning module: network, cross entropy, and mean IoU in each orientation."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler
from torchmetrics import Metric

from sphericalvision.core import ArgumentError
from sphericalvision.metrics import SolidAngleIoU
from sphericalvision.models.segmenter import SphereSegmenter
from sphericalvision.recipes.segmentation.rooms import ORIENTATIONS
from sphericalvision.recipes.training.orientations import OrientationModule

__all__ = ["SegmentationModule"]


class SegmentationModule(OrientationModule):
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

    def percent(self, score: Metric) -> Tensor:
        """Its mean IoU."""
        return 100 * score.compute()["mIoU"]  # type: ignore[no-any-return]
