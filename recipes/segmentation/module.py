# SPDX-License-Identifier: Apache-2.0
"""Segmentation on the sphere as a Lightning module: network, cross entropy, and mean IoU in each orientation."""

from pathlib import Path

from torch import Tensor
from torchmetrics import Metric

from sphericalvision.core import ArgumentError
from sphericalvision.metrics import SolidAngleIoU
from sphericalvision.recipes.segmentation.rooms import ORIENTATIONS
from sphericalvision.recipes.training.orientations import OrientationModule


class SegmentationModule(OrientationModule):
    """A segmenter on the sphere, validated and tested in every orientation; labels of -1 do not count."""

    metric_names = tuple(ORIENTATIONS)
    unit = "mean IoU in percent"

    def score(self) -> Metric:
        """Mean IoU by solid angle."""
        return SolidAngleIoU(self.net.grid, self.net.num_classes, ignore_index=-1)

    def initialize(self, weights: str | Path) -> None:
        """Refuse: there are no weights to start from."""
        raise ArgumentError(
            "init_weights: experiment=segmentation starts from nothing; leave init_weights out"
        )

    def percent(self, score: Metric) -> Tensor:
        """Mean IoU of a score."""
        return 100 * score.compute()["mIoU"]  # type: ignore[no-any-return]
