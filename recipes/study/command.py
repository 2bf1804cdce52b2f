# SPDX-License-Identifier: Apache-2.0
"""The paper's study, from training to tables and pictures: ``sphericalvision-study``.

Trains or loads every model, evaluates each at every angle of the cameras, and writes the paper's table. Everything
goes to one folder, and what is there already is not done again: the same command goes on after an interruption.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from sphericalvision.recipes.app.cli import console, print_config
from sphericalvision.recipes.study.data import View, views
from sphericalvision.recipes.study.jobs import Job, evaluate_jobs
from sphericalvision.recipes.study.models import StudyModel, study_models
from sphericalvision.recipes.study.report import report
from sphericalvision.recipes.study.training import Training, check_alike

__all__ = ["study"]


def study(config: DictConfig, folder: Path) -> list[dict[str, Any]]:
    """Train, evaluate and report as ``config`` says; returns the results of all models, seeds and views."""
    models, all_views = study_models(config), views(config)
    trainings = {
        (model.name, seed): Training.of(model, seed, config, folder)
        for model in models
        if model.is_trained
        for seed in config.seeds
    }
    print_config(config, folder)
    notes = check_alike(list(trainings.values()))
    for note in notes:
        console.print(f"[yellow]not the same for all:[/] {note}", highlight=False)
    train_all(config, list(trainings.values()))
    jobs = [job for model in models for job in jobs_of(model, config, all_views, trainings, folder)]
    results = [r for view in all_views for r in evaluate_jobs(config, [j for j in jobs if j.view == view])]
    report(config, folder, jobs, results, list(trainings.values()), notes)
    return results


def train_all(config: DictConfig, trainings: list[Training]) -> None:
    """Bring all trainings to their end; what was trained otherwise is told before anything begins."""
    for training in trainings:
        training.check(config.on_change)
    for training in trainings:
        if training.is_done:
            console.print(f"{training.name}: trained already", highlight=False)
        elif config.train:
            console.rule(training.name)
            training.run()
        else:
            console.print(f"{training.name}: not trained, left out (train=false)", highlight=False)


def jobs_of(
    model: StudyModel,
    config: DictConfig,
    all_views: list[View],
    trainings: dict[tuple[str, int], Training],
    folder: Path,
) -> list[Job]:
    """The evaluations of a model, but for seeds that are not trained."""
    jobs = []
    for seed in model.seeds(list(config.seeds)):
        training = trainings[model.name, seed] if model.is_trained and seed is not None else None
        if training is None or training.is_done:
            weights = model.given_checkpoint(seed) if training is None else training.weights
            jobs += [Job(model, seed, view, weights, folder) for view in all_views]
    return jobs
