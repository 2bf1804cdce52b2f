# SPDX-License-Identifier: Apache-2.0
"""What a study writes: tables, pictures, one page with all of them, and everything as JSON."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from sphericalvision.cameras import seen_by
from sphericalvision.core import ArgumentError
from sphericalvision.data import collate_samples
from sphericalvision.io.files import atomic_write
from sphericalvision.io.images import write_image
from sphericalvision.recipes.app.checkpoints import load_network
from sphericalvision.recipes.app.cli import print_table
from sphericalvision.recipes.study.data import View, study_frames
from sphericalvision.recipes.study.jobs import Job, scale_of
from sphericalvision.recipes.study.measures import Yardstick
from sphericalvision.recipes.study.pictures import PanelColumn, angle_plot, panel_sheet
from sphericalvision.recipes.study.tables import (
    Cell,
    Table,
    change_table,
    detail_table,
    input_table,
    paper_table,
    save_table,
    zone_table,
)
from sphericalvision.recipes.study.training import Training, write_json
from sphericalvision.sphere import Equirectangular
from sphericalvision.sphere.intake import unsigned
from sphericalvision.viz.panorama import icosphere_to_panorama, rgb_panorama

__all__ = ["model_table", "panel_column", "report"]


def report(
    config: DictConfig,
    folder: Path,
    jobs: list[Job],
    results: list[dict[str, Any]],
    trainings: list[Training],
    notes: list[str],
) -> None:
    """Write all tables and pictures to ``folder``, and print the paper's table.

    Raises:
        ArgumentError: there are no results.
    """
    if not results:
        raise ArgumentError(
            "models: nothing is trained yet, so there is nothing to report; leave out train=false"
        )
    facts = {job.model.name: job for job in jobs}
    models = model_table(list(facts.values()), trainings)
    tables = {
        "table": paper_table(results),
        "details": detail_table(results),
        "change": change_table(results),
        "where": zone_table(results),
    }
    if config.inputs == "equirect":
        tables["inputs"] = input_table(results)
    for name, table in tables.items():
        save_table(folder / name, table)
    write_image(folder / "errors_against_angle.png", angle_plot(results))
    _save_panels(config, folder, jobs)
    write_json(
        folder / "study.json",
        {
            "config": OmegaConf.to_container(config, resolve=True, throw_on_missing=False),
            "notes": notes,
            "trainings": [
                {"name": t.name, **json.loads(t.record.read_text())} for t in trainings if t.is_done
            ],
            "results": results,
        },
    )
    _save_page(folder, {"models": models, **tables}, notes)
    for name in ("table", "inputs"):
        if name in tables:
            rows = [
                ["–" if c is None else c if isinstance(c, str) else c.text() for c in r]
                for r in tables[name].rows
            ]
            print_table(tables[name].title, list(tables[name].columns), rows)
    print(f"Results are in {folder}")


def model_table(jobs: list[Job], trainings: list[Training]) -> Table:
    """What each model is: parameters, and what it was trained on; one job for each."""
    rows: list[list[str | Cell | None]] = []
    for job in jobs:
        mine = [training for training in trainings if training.folder.parent.name == job.model.name]
        parameters: str | None = None
        if job.model.kind == "depth_network":
            parameters = f"{sum(p.numel() for p in load_network(job.weights).parameters()):,}"
        row: list[str | Cell | None] = [job.model.label, parameters]
        if mine:
            c = mine[0].config
            per_step = c["data.batch_size"] * (c.get("trainer.accumulate_grad_batches") or 1)
            frames = c.get("data.num_train")
            row += [
                f"{c['trainer.max_steps']:,}",
                str(per_step),
                f"{frames:,}" if frames else c.get("data.root"),
            ]
            row += [str(len(mine))]
        else:
            row += [None] * 4
        rows.append(row)
    columns = ("model", "parameters", "steps", "frames a step", "training frames", "seeds")
    return Table("What was compared.", columns, [rows])


def panel_column(config: DictConfig, view: View, estimates: dict[str, Any]) -> PanelColumn:
    """The frame that is drawn, seen at one angle."""
    _, frames = study_frames(config, view)
    batch = collate_samples([frames[config.panel_frame]])
    truth = Yardstick(scale_of(config)).truth(batch)
    rig = batch["rig"].select(0)
    height = config.panel_height
    depth = icosphere_to_panorama(truth.inverse_depth[0].float(), height).reciprocal()
    images = {name: unsigned(image) for name, image in zip(rig.names, batch["fisheye"][0], strict=True)}
    colors, seen = rgb_panorama(rig, images, height, depth)
    picture = (
        (colors.where(seen, torch.tensor(0.6)).clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy()
    )
    index = truth.indices[0].where(truth.valid[0], math.nan).float()
    around = Equirectangular(height, 2 * height).directions.reshape(-1, 3)
    shared = seen_by(rig, around, depth.reciprocal().reshape(-1)).view(height, 2 * height) >= 2
    return PanelColumn(f"{view.angle_deg:g}°", picture, index, truth.counts[0], shared, estimates)


def _save_panels(config: DictConfig, folder: Path, jobs: list[Job]) -> None:
    """The first seed of every model."""
    views = dict.fromkeys(job.view for job in jobs if job.view.inputs == "fisheye")
    columns = []
    for view in views:
        estimates: dict[str, Any] = {}
        for job in jobs:
            if job.view == view and job.model.label not in estimates:
                estimates[job.model.label] = job.drawn()
        columns.append(panel_column(config, view, estimates))
    picture = panel_sheet(columns, config.num_hypotheses, config.model.min_depth)
    write_image(folder / "panels.png", picture)


def _save_page(folder: Path, tables: dict[str, Table], notes: list[str]) -> None:
    """All of it on one page."""
    headings = {
        "models": "Models",
        "table": "Errors by angle",
        "change": "Change with the angle",
        "inputs": "Equirectangular images without retraining",
        "details": "Other metrics",
    }
    parts = ["# Study", *(f"Not the same for all models: {note}." for note in notes)]
    for name, heading in headings.items():
        if name in tables:
            parts.append(f"## {heading}\n\n{tables[name].markdown().rstrip()}")
    parts.append("![Error against angle](errors_against_angle.png)\n\n![Depth maps](panels.png)")
    with atomic_write(folder / "study.md") as temporary:
        Path(temporary).write_text("\n\n".join(parts) + "\n")
