# SPDX-License-Identifier: Apache-2.0
"""Training of IcoSweepNet."""

from __future__ import annotations

from torch import Tensor

from sphericalvision.models import IcoSweepNet
from sphericalvision.recipes.training.lit_base import METRICS, IndexModule
from sphericalvision.viz.panorama import icosphere_to_panorama

__all__ = ["METRICS", "DepthModule"]


class DepthModule(IndexModule):
    """IcoSweepNet with the Huber loss on the hypothesis index, Adam, and the paper's metrics.

    Every argument is a plain scalar, so checkpoints load with ``weights_only=True`` and rebuild the network.

    Args:
        level: icosphere level of the images; depth is estimated at ``level - 2``.
        num_hypotheses: number of inverse-depth hypotheses N.
        min_depth: nearest hypothesis in metres.
        feature_channels: width C of the features.
        num_cameras: number of cameras of the rig.
        norm: "batch", or "instance" for batches of one or two.
        aggregation: "concatenation", or "variance" for any number of cameras and few training frames.
        feature_coarsening: levels by which features are coarser than images, 2 or 1.
        volume_channels: half the width of the regulariser; ``feature_channels`` when not given.
        recompute: train in less than half the memory, for a third more work; the results are the same.
        learning_rate: of Adam, at its highest.
        weight_decay: of Adam.
        schedule: ``"constant"``, ``"step"`` or ``"cosine"``; see ``learning_rate_factor``.
        schedule_steps: iteration at which a cosine ends.
        warmup_steps: iterations of linear rise.
        decay_after: iteration at which a step schedule drops.
        decay_factor: factor of that drop, or of the cosine's end.
        huber_delta: where the loss turns from quadratic to linear, in hypothesis indices.
        seed: with the iteration's number it seeds each training step, so that resuming changes nothing.
    """

    images_entry, truth_entry, valid_entry = "images", "inverse_depth", "valid"
    data_hint = "take data=scenes, data=omnithings or another set that is brought onto the icosphere"

    def __init__(
        self,
        level: int = 7,
        num_hypotheses: int = 32,
        min_depth: float = 0.55,
        feature_channels: int = 32,
        num_cameras: int = 4,
        norm: str = "batch",
        aggregation: str = "concatenation",
        feature_coarsening: int = 2,
        volume_channels: int | None = None,
        recompute: bool = False,
        learning_rate: float = 1e-3,
        weight_decay: float = 0.0,
        schedule: str = "step",
        schedule_steps: int = 54_000,
        warmup_steps: int = 0,
        decay_after: int = 36_000,
        decay_factor: float = 0.1,
        huber_delta: float = 1.0,
        seed: int = 0,
    ) -> None:
        net = IcoSweepNet(
            level,
            num_hypotheses,
            min_depth,
            feature_channels,
            num_cameras,
            norm=norm,
            aggregation=aggregation,
            feature_coarsening=feature_coarsening,
            volume_channels=volume_channels,
        )
        net.configure(recompute=recompute)
        super().__init__(net, schedule, schedule_steps)
        self.save_hyperparameters()

    def panorama(self, values: Tensor, height: int) -> Tensor:
        """Values ``(V,)`` of a frame, interpolated to ``(height, 2 * height)``."""
        return icosphere_to_panorama(values, height)
