# SPDX-License-Identifier: Apache-2.0
"""Tasks on the sphere that are validated and tested in several orientations."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, ClassVar, cast

from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler
from torch.utils.data import DataLoader, Dataset
from torchmetrics import Metric

from sphericalvision.core import check_choice
from sphericalvision.models.sphere_blocks import network_grid
from sphericalvision.recipes.app.kinds import Count
from sphericalvision.recipes.datamodules.data_module import Sample, SampleDataModule
from sphericalvision.recipes.training.module import TrainingModule


class OrientationModule(TrainingModule):
    """A network of classes, with a metric for each of the orientations that ``metric_names`` names.

    Args:
        net: the network; ``net.num_classes`` classes.
        loss: of logits and labels.
        optimizer: as of ``TrainingModule``, like the rest.
    """

    def __init__(
        self,
        net: nn.Module,
        loss: Callable[[Tensor, Tensor], Tensor],
        optimizer: Callable[..., Optimizer],
        scheduler: Callable[[Optimizer], LRScheduler],
        monitor: str = "val/upright",
        mode: str = "max",
        seed: int = 0,
    ) -> None:
        super().__init__(net, loss, optimizer, scheduler, monitor, mode, seed)
        #: Metrics of predicted and true classes; loaders are in their order.
        self.scores = nn.ModuleDict({name: self.score() for name in self.metric_names})

    def score(self) -> Metric:
        """A new metric. Every subclass implements it."""
        raise NotImplementedError(f"{type(self).__name__}.score")

    def percent(self, score: Metric) -> Tensor:
        """The value of a metric that is logged."""
        return 100 * cast(Tensor, score.compute())

    def forward(self, values: Tensor) -> Tensor:
        """Logits of values ``(B, in_channels, *grid.shape)``."""
        return self.net(values)  # type: ignore[no-any-return]

    def training_step(self, batch: dict[str, Any], batch_idx: int) -> Tensor:
        """The loss of one batch."""
        loss: Tensor = self.loss(self(batch["values"]), batch["label"])
        self.log("train/loss", loss, batch_size=len(batch["label"]))
        return loss

    def validation_step(self, batch: dict[str, Any], batch_idx: int, dataloader_idx: int = 0) -> None:
        """Compare classes in one orientation."""
        score = cast(Metric, list(self.scores.values())[dataloader_idx])
        score.update(self(batch["values"]).argmax(1), batch["label"])

    def on_validation_epoch_end(self) -> None:
        """Log ``val/upright`` and so on."""
        self._log_scores("val")

    test_step = validation_step

    def on_test_epoch_end(self) -> None:
        """Log ``test/upright`` and so on."""
        self._log_scores("test")

    def _log_scores(self, split: str) -> None:
        for name, module in self.scores.items():
            score = cast(Metric, module)
            self.log(f"{split}/{name}", self.percent(score), prog_bar=True, sync_dist=True)
            score.reset()


@dataclass(eq=False, repr=False)
class OrientedDataModule(SampleDataModule):
    """Samples on the grid of a network, trained in one orientation, validated and tested in each."""

    network: str = "hex"
    level: int = 4
    orientation: str = "upright"
    num_val: Count = 20
    num_test: Count = 60

    orientations: ClassVar[Iterable[str]]
    """Orientations of validation and test."""

    def __post_init__(self) -> None:
        check_choice("data.orientation", self.orientation, tuple(self.orientations))
        self.grid = network_grid(self.network, self.level)

    def dataset(self, split: str) -> Dataset[Sample]:
        """Samples of a split in the orientation of training."""
        return self.samples(split, self.orientation)

    def samples(self, split: str, orientation: str) -> Dataset[Sample]:
        """Samples of a split in any orientation. Every subclass implements it."""
        raise NotImplementedError(f"{type(self).__name__}.samples")

    def val_dataloader(self, rank: int = 0, world: int = 1) -> list[DataLoader[Sample]]:
        """Validation samples in each orientation."""
        return [self.part_of_process(self.samples("val", name), rank, world) for name in self.orientations]

    def test_dataloader(self, rank: int = 0, world: int = 1) -> list[DataLoader[Sample]]:
        """Test samples in each orientation."""
        return [self.part_of_process(self.samples("test", name), rank, world) for name in self.orientations]
