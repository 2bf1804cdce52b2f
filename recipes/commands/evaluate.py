# SPDX-License-Identifier: Apache-2.0
"""The paper's table row of a checkpoint: ``sphericalvision-evaluate checkpoint=... data=...``."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import pytorch_lightning as pl
import torch
from omegaconf import DictConfig, OmegaConf

from sphericalvision.core import check_choice
from sphericalvision.icosphere import Icosphere
from sphericalvision.models import IcoSweepNet, OmniMVS
from sphericalvision.recipes.app.checkpoints import load_network
from sphericalvision.recipes.app.cli import build, choose_device, print_config
from sphericalvision.recipes.datamodules.base import SampleDataModule
from sphericalvision.recipes.evaluation.inputs import VertexEstimator
from sphericalvision.recipes.evaluation.tables import (
    Estimator,
    Row,
    constant_estimators,
    evaluate,
    print_rows,
    save_rows,
    semi_global_estimator,
    sweep_estimator,
)

__all__ = ["Evaluation", "evaluate_checkpoint", "instantiate_evaluation"]


class Evaluation(NamedTuple):
    """A network and the data it is evaluated on."""

    net: IcoSweepNet | OmniMVS
    data: SampleDataModule


def instantiate_evaluation(config: DictConfig) -> Evaluation:
    """Load the network and make the data in its level and scale, unless ``config.model`` says otherwise.

    A network on panoramas has no level; it is evaluated at the vertices of level 3 unless ``model.level`` says
    otherwise.
    """
    net = load_network(config.checkpoint, None, config.model.min_depth, config.native)
    if isinstance(net, IcoSweepNet) and config.model.level not in (None, net.level):
        net = load_network(config.checkpoint, config.model.level, config.model.min_depth, config.native)
    level = net.level if isinstance(net, IcoSweepNet) else config.model.level or 5
    OmegaConf.update(config, "model.level", level)
    OmegaConf.update(config, "model.min_depth", net.min_depth)
    return Evaluation(net.to(choose_device(config.device)), build(config.data))


def evaluate_checkpoint(config: DictConfig, folder: Path) -> list[Row]:
    """Evaluate as ``config`` says; the table goes to ``folder`` as ``metrics.md``, ``.json`` and ``.csv``."""
    check_choice("split", config.split, ("train", "val", "test"))
    pl.seed_everything(config.seed, verbose=False)
    net, data = instantiate_evaluation(config)
    print_config(config, folder)
    data.render(config.split)
    frames = data.plain_train_dataset() if config.split == "train" else data.dataset(config.split)
    name = "IcoSweepNet" if config.checkpoint is None else Path(config.checkpoint).stem
    estimator = VertexEstimator(net)
    within = estimator.reaches(Icosphere(config.model.level - 2, device=net.sweep.directions.device).vertices)
    estimators: dict[str, Estimator] = {name: estimator}
    if config.baselines:
        data.render("train")
        estimators |= constant_estimators(data.loader(data.plain_train_dataset()), net)
        estimators["photo-consistency sweep"] = sweep_estimator(net)
        estimators["semi-global sweep"] = semi_global_estimator(net)
    with torch.inference_mode():
        rows = evaluate(estimators, data.loader(frames), net, within)
    h = net.hyperparameters
    print_rows(f"{config.split}, level {config.model.level}, percent of N = {h['num_hypotheses']}", rows)
    save_rows(folder / "metrics", rows)
    print(f"Saved in {folder}")
    return rows
