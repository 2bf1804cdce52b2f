# SPDX-License-Identifier: Apache-2.0
"""The paper's table row of a checkpoint: ``sphericalvision-evaluate checkpoint=... data=...``."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import torch
from omegaconf import DictConfig, OmegaConf

from sphericalvision.core import check_choice
from sphericalvision.icosphere import Icosphere
from sphericalvision.models import DepthNetwork
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

    net: DepthNetwork
    data: SampleDataModule


def instantiate_evaluation(config: DictConfig) -> Evaluation:
    """Load the network and make the data in its level and scale, unless ``config.model`` says otherwise.

    A network on panoramas has no level; it is evaluated at the vertices of level 3 unless ``model.level`` says
    otherwise.
    """
    level = config.model.level
    net = load_network(config.checkpoint, native=config.native)
    net = net.with_changes(level=level if net.images == "sphere" else None, min_depth=config.model.min_depth)
    OmegaConf.update(config, "model.level", net.level if net.images == "sphere" else level or 5)
    OmegaConf.update(config, "model.min_depth", net.min_depth)
    data: SampleDataModule = build(config.data, "data")
    data.serve(net, "sphere" if config.baselines else "depth", depth_level=config.model.level - 2)
    return Evaluation(net.to(choose_device(config.device)), data)


def evaluate_checkpoint(config: DictConfig, folder: Path) -> list[Row]:
    """Evaluate as ``config`` says; the table goes to ``folder`` as ``metrics.md``, ``.json`` and ``.csv``."""
    check_choice("split", config.split, ("train", "val", "test"))
    torch.manual_seed(config.seed)
    net, data = instantiate_evaluation(config)
    print_config(config, folder)
    data.render(config.split)
    frames = data.plain_train_dataset() if config.split == "train" else data.dataset(config.split)
    name = type(net).__name__ if config.checkpoint is None else Path(config.checkpoint).stem
    estimator = VertexEstimator(net)
    within = estimator.reaches(Icosphere(config.model.level - 2, device=net.device).vertices)
    estimators: dict[str, Estimator] = {name: estimator}
    if config.baselines:
        data.render("train")
        estimators |= constant_estimators(data.loader(data.plain_train_dataset()), net)
        estimators["photo-consistency sweep"] = sweep_estimator(net)
        estimators["semi-global sweep"] = semi_global_estimator(net)
    with torch.inference_mode():
        rows = evaluate(estimators, data.loader(frames), net, within)
    print_rows(f"{config.split}, level {config.model.level}, percent of N = {net.num_hypotheses}", rows)
    save_rows(folder / "metrics", rows)
    for sentence in data.left_out():
        print(f"Warning: {sentence}")
    print(f"Saved in {folder}")
    return rows
