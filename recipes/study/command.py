# SPDX-License-Identifier: Apache-2.0
"""The paper's study, from training to tables and pictures: ``sphericalvision-study``.

Trains or loads every model, evaluates each at every angle of the cameras, and writes the paper's table. Everything
goes to one folder, and what is there already is not done again: the same command goes on after an interruption.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytorch_lightning as pl
from omegaconf import DictConfig, OmegaConf

from sphericalvision.recipes.app.cli import choose_device, console, print_config
from sphericalvision.recipes.evaluation.frames import SampleFrames
from sphericalvision.recipes.evaluation.loop import evaluate
from sphericalvision.recipes.evaluation.protocols import Protocols
from sphericalvision.recipes.evaluation.records import Record
from sphericalvision.recipes.evaluation.views import View, study_frames, views
from sphericalvision.recipes.study.models import StudyModel, Version, scale_of, study_models
from sphericalvision.recipes.study.report import Evaluated, report
from sphericalvision.recipes.study.training import Training, check_alike, flat_config, train_all

__all__ = ["evaluate_view", "study"]

GENERATION = 3
"""Raised whenever an evaluation would come out otherwise, so that old ones are not taken."""

NO_MATTER = ("batch_size", "rig.", "entries", "seed", "num_test", "panorama_size", "num_train", "num_val")
"""Beginnings of keys of the data that leave an evaluation as it is, or that the study sets by itself."""


def study(config: DictConfig, folder: Path) -> list[dict[str, Any]]:
    """Train, evaluate and report as ``config`` says; returns the results of all models, seeds and views."""
    models, all_views = study_models(config), views(config)
    trainings = {
        (model.name, seed): Training.of(model.name, model.train, seed, config, folder)
        for model in models
        if model.is_trained
        for seed in config.seeds
    }
    print_config(config, folder)
    notes = check_alike(list(trainings.values()))
    for note in notes:
        console.print(f"[yellow]not the same for all:[/] {note}", highlight=False)
    train_all(config, list(trainings.values()))
    versions = [version for model in models for version in versions_of(model, config, trainings)]
    evaluated = [evaluate_view(config, view, versions, folder) for view in all_views] if versions else []
    return report(config, folder, versions, evaluated, list(trainings.values()), notes)


def versions_of(
    model: StudyModel, config: DictConfig, trainings: dict[tuple[str, int], Training]
) -> list[Version]:
    """The model of each seed, but for seeds that are not trained."""
    versions = []
    for seed in model.seeds(list(config.seeds)):
        training = trainings[model.name, seed] if model.is_trained and seed is not None else None
        if training is None or training.is_done:
            weights = model.given_checkpoint(seed) if training is None else training.weights
            versions.append(Version(model, seed, weights, config))
    return versions


def evaluate_view(config: DictConfig, view: View, versions: list[Version], folder: Path) -> Evaluated:
    """The records of all models in one view; what is missing is measured in one pass over the frames."""
    data, samples = study_frames(config, view)
    frames = SampleFrames(data, samples, view.name, [config.panel_frame])
    setting = _setting(config, view)
    records = {
        version.name: Record(
            folder / "evaluation" / version.name / f"{view.name}.json", {**setting, "model": version.identity}
        )
        for version in versions
    }
    missing = [
        version
        for version in versions
        if not all(records[version.name].has(name, name in frames.drawn) for name in frames.names)
    ]
    if missing:
        pl.seed_everything(config.seed, verbose=False)
        measure = Protocols(scale_of(config), config.model.level - 2, choose_device(config.device))
        evaluate([version.method for version in missing], frames, measure, records)
    return Evaluated(view, samples, {name: record.only(frames.names) for name, record in records.items()})


def _setting(config: DictConfig, view: View) -> dict[str, Any]:
    """What an evaluation depends on, beside the model; compared with that of a stored one."""
    data: dict[str, Any] = OmegaConf.to_container(config.data, resolve=True)  # type: ignore[assignment]
    flat = flat_config(OmegaConf.create({"data": data}))
    key = {k: v for k, v in flat.items() if not k.removeprefix("data.").startswith(NO_MATTER)}
    key |= {"generation": GENERATION, "hypotheses": list(scale_of(config)), "level": config.model.level}
    key |= {name: _plain(config[name]) for name in ("image_size", "panorama_size", "panel_frame")}
    if "rig" in config.data:
        fisheye = view.inputs == "fisheye"
        key["rig"] = _plain(config.rig if fisheye else config.equirect_rig)
        key["equirect_size"] = None if fisheye else _plain(config.equirect_size)
    return key


def _plain(node: Any) -> Any:
    return OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node
