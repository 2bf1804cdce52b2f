# SPDX-License-Identifier: Apache-2.0
"""The paper's study, from training to tables and pictures: ``sphericalvision-study``.

Trains or loads every model, evaluates each at every angle of the cameras, and writes the paper's table. Everything
goes to one folder, and finished work is not repeated: the same command resumes after an interruption.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import pytorch_lightning as pl
from annotated_types import Ge, MinLen
from omegaconf import DictConfig, OmegaConf
from pydantic import with_config
from typing_extensions import TypedDict

from sphericalvision.core import ArgumentError
from sphericalvision.io.images import write_image
from sphericalvision.recipes.app.cli import choose_device, print_config, say
from sphericalvision.recipes.app.kinds import STRICT, Count, Device, Number, OnlyWith, Size, Text
from sphericalvision.recipes.evaluation.loop import evaluate
from sphericalvision.recipes.evaluation.pictures import DrawnFrame, frames_sheet
from sphericalvision.recipes.evaluation.protocols import Protocols
from sphericalvision.recipes.evaluation.records import Record
from sphericalvision.recipes.evaluation.results import Results
from sphericalvision.recipes.evaluation.tables import save_report
from sphericalvision.recipes.study.models import scale_of, study_models
from sphericalvision.recipes.study.report import angle_plot, drawn_frame, study_tables
from sphericalvision.recipes.study.tilted_views import view_frames, views
from sphericalvision.recipes.study.training import differences, train_all


@with_config(STRICT)
class StudyKeys(TypedDict, total=False):
    """Keys of ``conf/study.yaml`` and its presets; those that are ``Any`` are compared where they are made."""

    output: Text
    checkpoint: Text | None
    angles_deg: Annotated[list[float], MinLen(1)]
    seeds: Annotated[list[Number], MinLen(1)]
    inputs: Literal["fisheye", "equirect"]
    num_hypotheses: Annotated[int, Ge(2)]
    model: Any
    models: Any
    data: Any
    rig: Annotated[Any, OnlyWith("data.rig", "data=scenes")]
    equirect_rig: Annotated[Any, OnlyWith("inputs=equirect")]
    frames: Count | None
    image_size: Size | None
    equirect_size: Annotated[Size | None, OnlyWith("inputs=equirect")]
    panorama_size: Size
    baseline_frames: Count
    panel_frame: Number
    panel_height: Count
    training: list[str]
    extra_training: list[str]
    train: bool
    on_change: Literal["refuse", "redo"]
    device: Device
    seed: Number


def study(config: Annotated[DictConfig, StudyKeys], folder: Path) -> Results:
    """Train, evaluate and report as ``config`` says; returns the results of all models, seeds and views."""
    models, all_views = study_models(config), views(config)
    trainings = [training for model in models for training in model.trainings(config, folder)]
    print_config(config, folder)
    notes = differences(trainings)
    for note in notes:
        say(f"Warning: {note}", style="yellow")
    train_all(trainings, config.train, config.on_change)
    methods = [method for model in models for method in model.methods(config, trainings)]
    if not methods:
        raise ArgumentError(
            "models: nothing is trained yet, so there is nothing to report; leave out train=false"
        )
    measure = Protocols(scale_of(config), config.model.level - 2, choose_device(config.device))
    all_records: dict[str, Mapping[str, Record]] = {}
    drawn: dict[str, DrawnFrame] = {}
    for view in all_views:
        frames = view_frames(config, view)
        pl.seed_everything(config.seed, verbose=False)
        records = all_records[view.name] = evaluate(methods, frames, measure, folder)
        for method in methods:  # at level 7 tables of a rig are hundreds of megabytes for each seed
            method.forget_rigs()
        if view.inputs == "fisheye":
            drawn[f"{view.angle_deg:g} degrees"] = drawn_frame(config, frames, methods, records)
    results = Results(methods, all_records)
    write_image(folder / "errors_against_angle.png", angle_plot(results, all_views, config.num_hypotheses))
    write_image(folder / "panels.png", frames_sheet(drawn))
    tables = study_tables(results, config, all_views)
    pictures = {"Error against angle": "errors_against_angle.png", "Depth maps": "panels.png"}
    content = {
        "config": OmegaConf.to_container(config, resolve=True, throw_on_missing=False),
        "notes": notes,
        "trainings": [
            {"name": t.name, "words": t.words, "config": t.settings} for t in trainings if t.is_done
        ],
        "results": results.plain(),
    }
    save_report(folder, "study", "Study", tables, pictures, content)
    return results
