# SPDX-License-Identifier: Apache-2.0
"""Classification on the sphere as a Lightning module: network, cross entropy, and accuracy in each orientation."""

from __future__ import annotations

from pathlib import Path

import torch
from torchmetrics import Metric
from torchmetrics.classification import MulticlassAccuracy

from sphericalvision.core import FileFormatError, check_file
from sphericalvision.models.classifier import SphereClassifier
from sphericalvision.models.weights.filling import made
from sphericalvision.recipes.app.checkpoints import refuse_others
from sphericalvision.recipes.digits.dataset import ORIENTATIONS
from sphericalvision.recipes.training.orientations import OrientationModule

__all__ = ["ClassificationModule"]


class ClassificationModule(OrientationModule):
    """A classifier on the sphere, validated and tested on upright and on rotated samples."""

    metric_names = ORIENTATIONS
    unit = "percent correct"

    def score(self) -> Metric:
        """Share of what is right."""
        return MulticlassAccuracy(self.net.hyperparameters["num_classes"], average="micro")

    def initialize(self, weights: str | Path) -> None:
        """Start from the parameters of a checkpoint of the same network.

        Raises:
            ArgumentError: the other network differs; the message names how.
        """
        other = self.stored_network(Path(weights))
        refuse_others(weights, other.hyperparameters, self.net.hyperparameters)
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
