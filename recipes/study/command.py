# SPDX-License-Identifier: Apache-2.0
"""The paper's study, from training to tables and pictures: ``sphericalvision-study``.

Trains or loads every model, evaluates each at every angle of the cameras, and writes the paper's table. Everything
goes to one folder, and what is there already is not done again: the same command goes on after an interruption.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytorch_lightning as pl
from omegaconf import DictConfig

from sphericalvision.core import ArgumentError
from sphericalvision.recipes.app.cli import choose_device, console, print_config
from sphericalvision.recipes.evaluation.loop import evaluate, records_of
from sphericalvision.recipes.evaluation.protocols import Protocols
from sphericalvision.recipes.study.benchmark import compare
from sphericalvision.recipes.study.models import methods_of, scale_of, study_models
from sphericalvision.recipes.study.report import Evaluated, report
from sphericalvision.recipes.study.training import Training, check_alike, train_all
from sphericalvision.recipes.study.views import view_frames, views

__all__ = ["run", "study"]


def run(config: DictConfig, folder: Path) -> Any:
    """The study, or with ``preset=benchmark`` the benchmark of methods."""
    return compare(config, folder) if "benchmark" in config else study(config, folder)


def study(config: DictConfig, folder: Path) -> list[dict[str, Any]]:
    """Train, evaluate and report as ``config`` says; returns the results of all models, seeds and views.

    Raises:
        ArgumentError: nothing is trained, and nothing is to be.
    """
    models, all_views = study_models(config), views(config)
    trainings = [
        Training.of(model.name, model.train, seed, config, folder)
        for model in models
        if model.is_trained
        for seed in config.seeds
    ]
    print_config(config, folder)
    notes = check_alike(trainings)
    for note in notes:
        console.print(f"[yellow]not the same for all:[/] {note}", highlight=False)
    train_all(config, trainings)
    methods = [method for model in models for method in methods_of(model, config, trainings)]
    if not methods:
        raise ArgumentError(
            "models: nothing is trained yet, so there is nothing to report; leave out train=false"
        )
    measure = Protocols(scale_of(config), config.model.level - 2, choose_device(config.device))
    evaluated = []
    for view in all_views:
        frames = view_frames(config, view)
        records = records_of(methods, frames, measure, folder)
        pl.seed_everything(config.seed, verbose=False)
        evaluate(methods, frames, measure, records)
        for method in methods:  # at level 7 tables of a rig are hundreds of megabytes for each seed
            method.forget_rigs()
        evaluated.append(
            Evaluated(view, frames.samples, {name: r.only(frames.names) for name, r in records.items()})
        )
    return report(config, folder, models, methods, evaluated, trainings, notes)
