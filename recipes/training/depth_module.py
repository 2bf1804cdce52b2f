# SPDX-License-Identifier: Apache-2.0
"""Training of depth networks: any ``DepthNetwork``, by the error of its hypothesis index."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.data.augmentation.simulated_hint import simulated_hint
from sphericalvision.icosphere import level_from_num_vertices
from sphericalvision.metrics import DepthIndexError
from sphericalvision.models import DepthNetwork
from sphericalvision.recipes.app.checkpoints import initialize
from sphericalvision.recipes.app.kinds import Fraction
from sphericalvision.recipes.datamodules.clues import clues_of
from sphericalvision.recipes.datamodules.entries import images_of, truth_of
from sphericalvision.recipes.training.module import TrainingModule
from sphericalvision.recipes.training.rig_tables import RigTables
from sphericalvision.sphere import Equirectangular
from sphericalvision.sweep import index_from_inverse_depth

METRICS = (">1", ">3", ">5", "MAE", "RMS")
"""Columns of the paper's tables, in order; percent of the number of hypotheses."""


class DepthModule(TrainingModule):
    """A depth network, a loss on the hypothesis index, and the paper's metrics.

    Args:
        net: the network; what it takes of a sample follows from ``net.images`` and ``net.grid``.
        loss: of index, true index and where that is known, all ``(B, *grid)``.
        optimizer: as of ``TrainingModule``, like scheduler, monitor, mode and seed.
        recompute: train in less memory for a third more work; the results are the same.
        learns: what the names of the weights that learn begin with; all learn when not given.
        hints: fraction of the samples that a network which takes hints sees with one simulated from the truth.
        mean_with: weights whose mean with those of ``init_weights`` training starts from; none when not given.
        compile: backend by which ``torch.compile`` makes one program of the loss, which takes minutes for each new
            number of cameras; none when not given.

    Raises:
        ArgumentError: ``torch.compile`` has no such backend, or no weight has a name that begins so.
    """

    metric_names = METRICS
    unit = "percent of N"
    learns_all = False
    """True if weights that a network keeps as they are learn, too."""

    def __init__(
        self,
        net: DepthNetwork,
        loss: Callable[[Tensor, Tensor, Tensor], Tensor],
        optimizer: Callable[..., Optimizer],
        scheduler: Callable[[Optimizer], LRScheduler],
        monitor: str = "val/MAE",
        mode: str = "min",
        recompute: bool = False,
        seed: int = 0,
        learns: Sequence[str] | None = None,
        hints: Fraction = 0.35,
        mean_with: Sequence[str] = (),
        compile: str | None = None,
    ) -> None:
        super().__init__(net, loss, optimizer, scheduler, monitor, mode, seed)
        if self.learns_all:
            net.requires_grad_(True)
        if learns is not None:
            net.requires_grad_(False)
            for beginning in learns:
                weights = [weight for name, weight in net.named_parameters() if name.startswith(beginning)]
                if not weights:
                    names = ", ".join(sorted({name.partition(".")[0] for name, _ in net.named_parameters()}))
                    raise ArgumentError(
                        f"task.learns: no weight of {type(net).__name__} has a name that begins with {beginning!r}; "
                        f"its parts are {names}"
                    )
                for weight in weights:
                    weight.requires_grad_(True)
        self.hints, self.mean_with = hints, mean_with
        net.configure(recompute=recompute)
        if compile is not None:
            check_choice("task.compile", compile, tuple(torch.compiler.list_backends(exclude_tags=())))
        self.backend = compile
        self.tables, self.training_loss = RigTables(net), self._loss_of(net)
        self._others: dict[int, tuple[DepthNetwork, RigTables, Callable[..., Tensor]]] = {}
        self.validation_metric = DepthIndexError(net.num_hypotheses)

    def initialize(self, weights: str | Path) -> None:
        """Start from the parameters of another network, see ``checkpoints.initialize``; or from the mean of several.

        References:
            Wortsman et al. (2022), "Model soups: averaging weights of multiple fine-tuned models improves accuracy
            without increasing inference time": of stages of one training, too, which start from one another.
        """
        initialize(self.net, weights)
        for number, each in enumerate(self.mean_with, start=2):
            mean = {name: value.clone() for name, value in self.net.state_dict().items()}
            initialize(self.net, each)
            # By differences: what is the same in all, as the prior, stays the same to the bit.
            means = {
                name: mean[name] + (value - mean[name]) / number
                for name, value in self.net.state_dict().items()
            }
            self.net.load_state_dict(means)

    def forward(self, images: Tensor, rig: Any, seen: Tensor | None = None) -> Tensor:
        """Hypothesis index of images seen by ``rig``, on the network's grid."""
        return self.net(images, rig, seen)  # type: ignore[no-any-return]

    def estimate(self, batch: dict[str, Any]) -> Tensor:
        """Hypothesis index of a batch."""
        images, seen = images_of(batch, self.net)
        return self(images, self.tables.of(batch["rig"]), seen)  # type: ignore[no-any-return]

    def target(self, batch: dict[str, Any]) -> tuple[Tensor, Tensor]:
        """Hypothesis index of the true inverse depth, fractional, and where it is known."""
        return _target(batch, self.net)

    def panorama(self, values: Tensor, height: int) -> Tensor:
        """Values ``(*grid)`` of a frame as a panorama of ``height`` rows; NaN where the grid does not reach."""
        view = Equirectangular(height, 2 * height, device=values.device)
        seen, reached = self.net.index_at(values[None], view.directions.reshape(-1, 3))
        return seen[0].where(reached, math.nan).view(view.shape)  # type: ignore[no-any-return]

    def training_step(self, batch: dict[str, Any], batch_idx: int) -> Tensor:
        """The loss of one batch."""
        net, tables, training_loss = self._at_level_of(batch)
        images, seen = images_of(batch, net)
        more: dict[str, Any] = {}
        if net.takes_hints and self.hints:
            more["hint"] = simulated_hint(batch["inverse_depth"], batch["valid"], seen, share=self.hints)
        if "clues" in batch:  # most of what tables are made for has been computed already
            rig, more["clues"] = batch["rig"], clues_of(batch)
        else:
            rig = tables.of(batch["rig"])
        loss: Tensor = training_loss(images, rig, seen, *_target(batch, net), self.loss, **more)
        self.log("train/loss", loss, batch_size=len(images))
        return loss

    def _loss_of(self, net: DepthNetwork) -> Callable[..., Tensor]:
        if self.backend is None:
            return net.training_loss
        return torch.compile(net.training_loss, backend=self.backend)

    def _at_level_of(self, batch: dict[str, Any]) -> tuple[DepthNetwork, RigTables, Callable[..., Tensor]]:
        """The network for the images of a batch, all with the same weights, with its tables and its loss."""
        images = batch.get("images")
        if self.net.images == "camera" or images is None:
            return self.net, self.tables, self.training_loss
        level = level_from_num_vertices(images.shape[-1])
        has_coarser_truth = batch["inverse_depth"].shape[-1] < images.shape[-1]
        if level == self.net.level or (level == self.net.image_level and has_coarser_truth):
            return self.net, self.tables, self.training_loss
        if level not in self._others:  # not before the network has been moved to its device
            net = self.net.at_level(level)
            self._others[level] = net, RigTables(net), self._loss_of(net)
        return self._others[level]

    def validation_step(self, batch: dict[str, Any], batch_idx: int) -> Tensor:
        """Gather the paper's errors of one batch; returns the index."""
        index = self.estimate(batch)
        target, valid = self.target(batch)
        self.validation_metric.update(index.flatten(1), target.flatten(1), valid.flatten(1))
        return index

    def on_validation_epoch_end(self) -> None:
        """Log ``val/over_1``, ``val/over_3``, ``val/over_5``, ``val/MAE`` and ``val/RMS``."""
        values = self.validation_metric.compute()
        self.validation_metric.reset()
        for name in METRICS:
            key = f"val/{name.replace('>', 'over_')}"
            self.log(key, values[name], prog_bar=name == "MAE", sync_dist=True)


def _target(batch: dict[str, Any], net: DepthNetwork) -> tuple[Tensor, Tensor]:
    inverse_depth, valid = truth_of(batch, net)
    return index_from_inverse_depth(inverse_depth, net.num_hypotheses, net.min_depth), valid
