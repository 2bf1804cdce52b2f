# SPDX-License-Identifier: Apache-2.0
"""What the training of all depth networks shares: loss, metrics, seeds and optimiser."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytorch_lightning as pl
import torch
from torch import Tensor

from sphericalvision.core import ArgumentError
from sphericalvision.losses import depth_index_huber
from sphericalvision.metrics import DepthIndexError
from sphericalvision.models import IcoSweepNet, OmniMVS
from sphericalvision.recipes.app.checkpoints import initialize, load_network
from sphericalvision.recipes.training.optimization import adam_with_schedule, check_schedule
from sphericalvision.recipes.training.rig_tables import RigTables
from sphericalvision.sweep import index_from_inverse_depth

__all__ = ["METRICS", "IndexModule"]

METRICS = (">1", ">3", ">5", "MAE", "RMS")
"""Columns of the paper's tables, in order; percent of the number of hypotheses."""


class IndexModule(pl.LightningModule):
    """A network of hypothesis indices with the Huber loss, Adam, and the paper's metrics.

    Subclasses say in which entries of a batch their images and their truth are, and make the network.

    Args:
        net: the network to train.
        schedule: of the learning rate; see ``optimization``.
        schedule_steps: iteration at which a cosine ends.
    """

    metric_names = METRICS
    monitor = ("val/MAE", "min")
    unit = "percent of N"

    images_entry: str
    """Key of the images in a batch."""
    truth_entry: str
    """Key of the true inverse depth on the network's grid."""
    valid_entry: str
    """Key of where that is known."""
    data_hint: str
    """What data hold all that, for messages."""

    def __init__(self, net: IcoSweepNet | OmniMVS, schedule: str, schedule_steps: int) -> None:
        super().__init__()
        check_schedule(schedule, schedule_steps)
        self.net = net
        self.tables = RigTables(net.sweep)
        self.validation_metric = DepthIndexError(net.num_hypotheses)

    def initialize(self, weights: str | Path) -> None:
        """Start from the parameters of another network; see ``checkpoints.initialize``."""
        initialize(self.net, weights)

    @staticmethod
    def stored_network(checkpoint: Path) -> IcoSweepNet | OmniMVS:
        """The network of a checkpoint of this module."""
        return load_network(checkpoint)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Say in the checkpoint which network's it is."""
        checkpoint["architecture"] = type(self.net).__name__

    def forward(self, images: Tensor, rig: Any) -> Tensor:
        """Hypothesis index of images seen by ``rig``, on the network's grid."""
        return self.net(images, rig)  # type: ignore[no-any-return]

    def estimate(self, batch: dict[str, Any]) -> Tensor:
        """Hypothesis index of a batch."""
        return self(self.entry(batch, self.images_entry), self.tables.of(batch["rig"]))  # type: ignore[no-any-return]

    def target(self, batch: dict[str, Any]) -> Tensor:
        """Hypothesis index of the true inverse depth; fractional, not rounded."""
        inverse_depth = self.on_grid(self.entry(batch, self.truth_entry))
        return index_from_inverse_depth(inverse_depth, self.net.num_hypotheses, self.net.min_depth)

    def valid(self, batch: dict[str, Any]) -> Tensor:
        """Where the truth is known."""
        return self.on_grid(self.entry(batch, self.valid_entry))

    def entry(self, batch: dict[str, Any], key: str) -> Any:
        """An entry of a batch.

        Raises:
            ArgumentError: these data do not hold it; the message says which do.
        """
        if key not in batch:
            raise ArgumentError(
                f"data: {type(self.net).__name__} wants the entry '{key}', samples hold {', '.join(batch)}; "
                f"{self.data_hint}"
            )
        return batch[key]

    def on_grid(self, values: Tensor) -> Tensor:
        """The part of the truth that lies on the network's grid."""
        return values

    def panorama(self, values: Tensor, height: int) -> Tensor:
        """Values of a frame on the network's grid as a panorama to look at, about ``height`` rows high."""
        raise NotImplementedError

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        """Seed what is drawn at random inside the step from its number alone."""
        torch.manual_seed(self.hparams["seed"] * 1_000_003 + self.global_step)

    def training_step(self, batch: dict[str, Any], batch_idx: int) -> Tensor:
        """Huber loss of one batch."""
        index = self.estimate(batch)
        loss = depth_index_huber(
            index, self.target(batch), self.valid(batch), delta=self.hparams["huber_delta"]
        )
        self.log("train/loss", loss, prog_bar=True, batch_size=len(index))
        return loss

    def validation_step(self, batch: dict[str, Any], batch_idx: int) -> Tensor:
        """Gather the paper's errors of one batch; returns the index."""
        index = self.estimate(batch)
        self.validation_metric.update(
            index.flatten(1), self.target(batch).flatten(1), self.valid(batch).flatten(1)
        )
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
