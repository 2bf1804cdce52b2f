# SPDX-License-Identifier: Apache-2.0
"""Classification on the sphere as a Lightning module: network, cross entropy, and accuracy in each orientation."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any, cast

import pytorch_lightning as pl
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torchmetrics.classification import MulticlassAccuracy

from sphericalvision.core import ArgumentError, FileFormatError, check_file
from sphericalvision.models.classifier import SphereClassifier
from sphericalvision.recipes.digits.dataset import ORIENTATIONS
from sphericalvision.recipes.training.optimization import adam_with_schedule, check_schedule

__all__ = ["ClassificationModule"]


class ClassificationModule(pl.LightningModule):
    """``SphereClassifier`` with cross entropy and Adam, validated and tested on upright and on rotated samples.

    Every argument is a plain scalar, so checkpoints load with ``weights_only=True`` and rebuild the network.

    Args:
        network: ``"crown"``, ``"hex"``, ``"sphere"`` or ``"planar"``.
        level: of the icosphere, or of the equirectangular image with about as many pixels.
        num_classes: number of classes.
        width: channels of the first layer; about equal numbers of parameters for all networks when not given.
        orientation: of the training samples; the best checkpoint is the best on validation samples like them.
        learning_rate: of Adam, at its highest.
        weight_decay: of Adam.
        schedule: ``"constant"``, ``"step"`` or ``"cosine"``; see ``learning_rate_factor``.
        schedule_steps: iteration at which a cosine ends.
        warmup_steps: iterations of linear rise.
        decay_after: iteration at which a step schedule drops.
        decay_factor: factor of that drop, or of the cosine's end.
        seed: with the iteration's number it seeds each training step, so that resuming changes nothing.
    """

    metric_names = ORIENTATIONS
    unit = "percent correct"

    def __init__(
        self,
        network: str = "hex",
        level: int = 4,
        num_classes: int = 10,
        width: int | None = None,
        orientation: str = "upright",
        learning_rate: float = 3e-3,
        weight_decay: float = 0.0,
        schedule: str = "cosine",
        schedule_steps: int = 1000,
        warmup_steps: int = 0,
        decay_after: int = 0,
        decay_factor: float = 0.01,
        seed: int = 0,
    ) -> None:
        super().__init__()
        check_schedule(schedule, schedule_steps)
        self.save_hyperparameters()
        self.net = SphereClassifier(network, level, num_classes, width=width)
        self.accuracies = nn.ModuleDict(
            {name: MulticlassAccuracy(num_classes, average="micro") for name in ORIENTATIONS}
        )

    @property
    def monitor(self) -> tuple[str, str]:
        """The validated value that chooses the best checkpoint, and its best direction."""
        return f"val/{self.hparams['orientation']}", "max"

    def initialize(self, weights: str | Path) -> None:
        """Start from the parameters of a checkpoint of the same network.

        Raises:
            ArgumentError: the other network differs; the message names the first difference.
        """
        other = self.stored_network(Path(weights))
        for key, value in self.net.hyperparameters.items():
            if other.hyperparameters[key] != value:
                raise ArgumentError(
                    f"init_weights: {weights} has {key} = {other.hyperparameters[key]}, the network to train has "
                    f"{value}; set model.{key}={other.hyperparameters[key]} or take other weights"
                )
        self.net.load_state_dict(other.state_dict())

    @staticmethod
    def stored_network(checkpoint: Path) -> SphereClassifier:
        """The network of a checkpoint of this module.

        Raises:
            MissingFileError: no such file.
            FileFormatError: the file is no checkpoint of a classifier.
        """
        path = check_file(checkpoint, "a checkpoint (.ckpt) of a classifier")
        try:
            module = ClassificationModule.load_from_checkpoint(path, map_location="cpu", weights_only=True)
        except (pickle.UnpicklingError, RuntimeError, EOFError, KeyError, TypeError, ValueError) as error:
            raise FileFormatError(
                f"{path}: is not a checkpoint of a classifier, or is damaged ({str(error).splitlines()[0]:.200}); "
                "give a .ckpt file from the checkpoints folder of experiment=spherical_digits"
            ) from error
        return module.net

    def forward(self, values: Tensor) -> Tensor:
        """Logits ``(B, num_classes)`` of values ``(B, 1, *grid.shape)``."""
        return self.net(values)

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        """Seed what is drawn at random inside the step from its number alone."""
        torch.manual_seed(self.hparams["seed"] * 1_000_003 + self.global_step)

    def training_step(self, batch: dict[str, Any], batch_idx: int) -> Tensor:
        """Cross entropy of one batch."""
        loss = F.cross_entropy(self(batch["values"]), batch["label"])
        self.log("train/loss", loss, prog_bar=True, batch_size=len(batch["label"]))
        return loss

    def validation_step(self, batch: dict[str, Any], batch_idx: int, dataloader_idx: int = 0) -> None:
        """Count what is right; loaders are in the order of ``ORIENTATIONS``."""
        accuracy = cast(MulticlassAccuracy, self.accuracies[ORIENTATIONS[dataloader_idx]])
        accuracy.update(self(batch["values"]), batch["label"])

    def on_validation_epoch_end(self) -> None:
        """Log ``val/upright`` and ``val/rotated``, percent correct."""
        self._log_accuracies("val")

    def test_step(self, batch: dict[str, Any], batch_idx: int, dataloader_idx: int = 0) -> None:
        """Count what is right; loaders are in the order of ``ORIENTATIONS``."""
        self.validation_step(batch, batch_idx, dataloader_idx)

    def on_test_epoch_end(self) -> None:
        """Log ``test/upright`` and ``test/rotated``, percent correct."""
        self._log_accuracies("test")

    def configure_optimizers(self) -> Any:
        """Adam with the schedule stepped at every iteration."""
        return adam_with_schedule(self.net.parameters(), self.hparams)

    def _log_accuracies(self, split: str) -> None:
        for name in ORIENTATIONS:
            accuracy = cast(MulticlassAccuracy, self.accuracies[name])
            self.log(f"{split}/{name}", 100 * accuracy.compute(), prog_bar=True)
            accuracy.reset()
