# SPDX-License-Identifier: Apache-2.0
"""Training that all networks share: optimiser, schedule, seeds, and contents of checkpoints."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
import torch
from torch.nn.utils import parameters_to_vector, vector_to_parameters
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from sphericalvision.core import ArgumentError
from sphericalvision.models.weights.registry import network_name
from sphericalvision.recipes.training.schedule import progress_only


def name_of(net: Any) -> str:
    """The registered name of a network, or the name of its class."""
    try:
        return network_name(net)
    except ArgumentError:
        return type(net).__name__


class TrainingModule(pl.LightningModule):
    """A network, a loss, an optimiser and a schedule.

    Args:
        net: the network, with ``hyperparameters`` that are plain values: they go into checkpoints and loggers.
        loss: what is made small.
        optimizer: makes the optimiser of parameters.
        scheduler: makes the schedule of an optimiser, stepped at every iteration.
        monitor: the validated value that chooses the best checkpoint.
        mode: "min" or "max", its best direction.
        seed: with the iteration's number it seeds each training step, so that resuming changes nothing.
    """

    metric_names: tuple[str, ...]
    """Names of the values in the final table."""
    unit: str
    """Unit of these values."""

    def __init__(
        self,
        net: Any,
        loss: Callable[..., Any],
        optimizer: Callable[..., Optimizer],
        scheduler: Callable[[Optimizer], LRScheduler],
        monitor: str,
        mode: str = "min",
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.net: Any = net
        self.loss = loss
        self.make_optimizer, self.make_scheduler = optimizer, scheduler
        self.monitor, self.mode, self.seed = monitor, mode, seed
        #: The step after which validation ran last, while training.
        self.validated_step = -1
        self.save_hyperparameters({"network": type(net).__name__, **net.hyperparameters, "seed": seed})

    def initialize(self, weights: str | Path) -> None:
        """Start from the parameters of another network; a subclass says which suit."""
        raise NotImplementedError(f"{type(self).__name__}.initialize, which init_weights=... needs")

    def write_report(
        self, data: Any, values: dict[str, float], init_weights: str | None, folder: Path
    ) -> None:
        """Say and write what there is to, once the best checkpoint is loaded and validated; most have nothing.

        Args:
            data: the data module.
            values: validated.
            init_weights: what training started from, as the configuration has it.
            folder: of the run.
        """

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Say in the checkpoint which network's it is."""
        checkpoint["architecture"] = name_of(self.net)
        checkpoint["network_hyperparameters"] = self.net.hyperparameters

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take how far schedule and batches are from the checkpoint, and settings of the schedule from this run."""
        states = checkpoint.get("lr_schedulers", [])
        checkpoint["lr_schedulers"] = [progress_only(state) for state in states]
        if (batches := self.trainer.accumulate_grad_batches) > 1:
            # Of a step that was not taken, the gradients so far are gone: all of its batches come again.
            progress = checkpoint["loops"]["fit_loop"]["epoch_loop.batch_progress"]
            for counts in (progress["total"], progress["current"]):
                counts.update(dict.fromkeys(counts, batches * checkpoint["global_step"]))

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        """Seed the random draws inside the step by its number alone."""
        torch.manual_seed(self.seed * 1_000_003 + self.global_step)

    def on_before_optimizer_step(self, optimizer: Optimizer) -> None:
        """Take no part of a gradient that is no number: one such sample would be the end of a training of hours."""
        gradients = [weight.grad for weight in self.net.parameters() if weight.grad is not None]
        if gradients:
            # In one row: a device is asked for two operators, not for one a weight.
            row = parameters_to_vector(gradients).nan_to_num_(0.0, 0.0, 0.0)
            vector_to_parameters(row, gradients)

    def on_validation_end(self) -> None:
        """Note which state has been validated."""
        if self.trainer.state.fn == "fit" and not self.trainer.sanity_checking:
            self.validated_step = self.trainer.global_step

    def configure_optimizers(self) -> Any:
        """The optimiser, with the schedule stepped at every iteration."""
        optimizer = self.make_optimizer(self.net.parameters())
        scheduler = self.make_scheduler(optimizer)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}
