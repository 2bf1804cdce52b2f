# SPDX-License-Identifier: Apache-2.0
"""Classification on the sphere as a Lightning module: network, cross entropy, and accuracy in each orientation."""

from pathlib import Path
from typing import Any

from torchmetrics import Metric
from torchmetrics.classification import MulticlassAccuracy

from sphericalvision.core import check_file
from sphericalvision.models.classifier import SphereClassifier
from sphericalvision.models.weights.filling import make_network
from sphericalvision.recipes.app.checkpoints import read_checkpoint, refuse_others
from sphericalvision.recipes.digits.dataset import ORIENTATIONS
from sphericalvision.recipes.training.orientations import OrientationModule


class ClassificationModule(OrientationModule):
    """A classifier on the sphere, validated and tested on upright and on rotated samples."""

    metric_names = ORIENTATIONS
    unit = "percent correct"

    def score(self) -> Metric:
        """Fraction of right answers."""
        return MulticlassAccuracy(self.net.hyperparameters["num_classes"], average="micro")

    def initialize(self, weights: str | Path) -> None:
        """Start from the parameters of a checkpoint of the same network."""
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

        def classifier_of(content: dict[str, Any]) -> SphereClassifier:
            stored = content["state_dict"].items()
            state = {key[4:]: value for key, value in stored if key.startswith("net.")}
            return make_network(SphereClassifier, content["network_hyperparameters"], state, checkpoint)

        check_file(checkpoint, "a checkpoint (.ckpt) of a classifier")
        return read_checkpoint("init_weights", checkpoint, "a checkpoint of a classifier", classifier_of)
