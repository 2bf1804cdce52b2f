# SPDX-License-Identifier: Apache-2.0
"""What a network must beat: constants of a training set, and sweeps that need no training."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from rich.progress import track
from torch.utils.data import DataLoader

from sphericalvision.core import ArgumentError
from sphericalvision.models import ConstantDepth, DepthNetwork, SemiGlobalSweep, WinnerTakesAll
from sphericalvision.recipes.evaluation.methods import Method

if TYPE_CHECKING:
    from sphericalvision.recipes.datamodules.base import SampleDataModule

__all__ = ["baselines", "constants", "sweep"]


def baselines(net: DepthNetwork, level: int, data: SampleDataModule) -> list[Method]:
    """The methods that a network is compared with, on images of a level; constants are those of the training set."""
    data.render("train")
    return [
        *constants(net, level, data.loader(data.plain_train_dataset())),
        sweep("photo-consistency sweep", WinnerTakesAll, net, level),
        sweep("semi-global sweep", SemiGlobalSweep, net, level),
    ]


def sweep(
    name: str, kind: type[WinnerTakesAll] | type[SemiGlobalSweep], net: DepthNetwork, level: int
) -> Method:
    """A sweep with the hypotheses of a network, on images of a level."""
    return Method(name, kind(level, net.num_hypotheses, net.min_depth).to(net.device))


def constants(net: DepthNetwork, level: int, loader: DataLoader[dict[str, Any]]) -> list[Method]:
    """The best depth map and the best single depth of frames for the mean absolute error, with a network's hypotheses.

    Raises:
        ArgumentError: no frame has a valid depth.
    """
    batches = [(b["inverse_depth"], b["valid"]) for b in track(loader, "training depths", total=len(loader))]
    if not any(valid.any() for _, valid in batches):
        raise ArgumentError(
            "baselines: the training set has no valid depth to take the median of; check data.*"
        )
    inverse_depth, valid = map(torch.cat, zip(*batches, strict=True))
    shapes = {"constant depth map": inverse_depth.shape, "constant depth": (-1, 1)}
    fresh = {name: ConstantDepth(level, net.num_hypotheses, net.min_depth) for name in shapes}
    return [
        Method(name, fresh[name].fit(inverse_depth.reshape(shape), valid.reshape(shape)).to(net.device))
        for name, shape in shapes.items()
    ]
