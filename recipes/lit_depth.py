# SPDX-License-Identifier: Apache-2.0
"""The training loop's one object: a depth network, its loss, its metrics and its optimiser."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytorch_lightning as pl
import torch
from torch import Tensor

from sphericalvision.losses import depth_index_huber
from sphericalvision.metrics import DepthIndexError
from sphericalvision.models import IcoSweepNet
from sphericalvision.recipes.checkpoints import initialize, load_network
from sphericalvision.recipes.optimization import adam_with_schedule, check_schedule
from sphericalvision.recipes.rig_tables import RigTables
from sphericalvision.sweep import index_from_inverse_depth

__all__ = ["METRICS", "DepthModule"]

METRICS = (">1", ">3", ">5", "MAE", "RMS")
"""Columns of the paper's tables, in order; percent of the number of hypotheses."""


class DepthModule(pl.LightningModule):
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

    metric_names = METRICS
    monitor = ("val/MAE", "min")
    unit = "percent of N"

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
        super().__init__()
        check_schedule(schedule, schedule_steps)
        self.save_hyperparameters()
        self.net = IcoSweepNet(
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
        self.net.recompute = recompute
        self.tables = RigTables(self.net.sweep)
        self.validation_metric = DepthIndexError(num_hypotheses)

    def initialize(self, weights: str | Path) -> None:
        """Start from the parameters of another network; see ``checkpoints.initialize``."""
        initialize(self.net, weights)

    @staticmethod
    def stored_network(checkpoint: Path) -> IcoSweepNet:
        """The network of a checkpoint of this module."""
        return load_network(checkpoint)

    def forward(self, images: Tensor, rig: Any) -> Tensor:
        """Hypothesis index ``(B, V)`` of sphere images ``(B, n, 3, V_level)`` seen by ``rig``."""
        return self.net(images, rig)

    def target(self, batch: dict[str, Any]) -> Tensor:
        """Hypothesis index ``(B, V)`` of the true inverse depth; fractional, not rounded."""
        return index_from_inverse_depth(
            batch["inverse_depth"],
            self.net.hyperparameters["num_hypotheses"],
            self.net.hyperparameters["min_depth"],
        )

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        """Seed what is drawn at random inside the step from its number alone."""
        torch.manual_seed(self.hparams["seed"] * 1_000_003 + self.global_step)

    def training_step(self, batch: dict[str, Any], batch_idx: int) -> Tensor:
        """Huber loss of one batch."""
        index = self(batch["images"], self.tables.of(batch["rig"]))
        loss = depth_index_huber(index, self.target(batch), batch["valid"], delta=self.hparams["huber_delta"])
        self.log("train/loss", loss, prog_bar=True, batch_size=len(index))
        return loss

    def validation_step(self, batch: dict[str, Any], batch_idx: int) -> Tensor:
        """Gather the paper's errors of one batch; returns the index ``(B, V)``."""
        index = self(batch["images"], self.tables.of(batch["rig"]))
        self.validation_metric.update(index, self.target(batch), batch["valid"])
        return index

    def on_validation_epoch_end(self) -> None:
        """Log ``val/over_1``, ``val/over_3``, ``val/over_5``, ``val/MAE`` and ``val/RMS``."""
        values = self.validation_metric.compute()
        self.validation_metric.reset()
        for name in METRICS:
            self.log(f"val/{name.replace('>', 'over_')}", values[name], prog_bar=name == "MAE")

    def configure_optimizers(self) -> Any:
        """Adam with the schedule stepped at every iteration."""
        return adam_with_schedule(self.net.parameters(), self.hparams)
