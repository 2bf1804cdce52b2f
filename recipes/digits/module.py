# SPDX-License-Identifier: Apache-2.0
"""Classification on the sphere as a Lightning module: network, cross entropy, and accuracy in each orientation."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler
from torchmetrics.classification import MulticlassAccuracy

from sphericalvision.core import ArgumentError, FileFormatError, check_file
from sphericalvision.models.classifier import SphereClassifier
from sphericalvision.models.weights.filling import made
from sphericalvision.recipes.digits.dataset import ORIENTATIONS
from sphericalvision.recipes.training.orientations import OrientationModule

__all__ = ["ClassificationModule"]


class ClassificationModule(OrientationModule):
    """A classifier on the sphere, validated and tested on upright and on rotated samples.

    Args:
        net: the network; ``net.num_classes`` classes.
        loss: of logits and labels.
        optimizer: makes the optimiser of parameters.
        scheduler: makes the schedule of an optimiser.
        monitor: the validated value that chooses the best checkpoint.
        mode: "min" or "max", its best direction.
        seed: of each training step, with its number.
    """

    metric_names = ORIENTATIONS
    unit = "percent correct"

    def __init__(
        self,
        net: SphereClassifier,
        loss: Callable[[Tensor, Tensor], Tensor],
        optimizer: Callable[..., Optimizer],
        scheduler: Callable[[Optimizer], LRScheduler],
        monitor: str = "val/upright",
        mode: str = "max",
        seed: int = 0,
    ) -> None:
        super().__init__(net, loss, optimizer, scheduler, monitor, mode, seed)
        number = net.hyperparameters["num_classes"]
        self.scores = nn.ModuleDict(
            {name: MulticlassAccuracy(number, average="micro") for name in ORIENTATIONS}
        )

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
            content = torch.load(path, map_location="cpu", weights_only=True)
            stored = content["state_dict"].items()
            state = {key[4:]: value for key, value in stored if key.startswith("net.")}
            return made(SphereClassifier, content["network_hyperparameters"], state, path)
        except FileFormatError:
            raise
        except Exception as error:  # whatever a damaged file makes of itself
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise FileFormatError(
                f"{path}: is not a checkpoint of a classifier, or is damaged ({reason:.200}); "
                "give a .ckpt file from the checkpoints folder of experiment=spherical_digits"
            ) from error
