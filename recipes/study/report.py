# SPDX-License-Identifier: Apache-2.0
"""What a study writes: tables, pictures, one page with all of them, and everything as JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from matplotlib.figure import Figure
from omegaconf import DictConfig, OmegaConf
from torch import Tensor
from torch.utils.data import Dataset

from sphericalvision.data import collate_samples
from sphericalvision.io.images import write_image
from sphericalvision.recipes.evaluation.methods import Method
from sphericalvision.recipes.evaluation.pictures import DrawnFrame, Picture, color_picture
from sphericalvision.recipes.evaluation.protocols import Protocols
from sphericalvision.recipes.evaluation.records import Record, values_of, write_json
from sphericalvision.recipes.evaluation.tables import Row, Table, save_report, summarize
from sphericalvision.recipes.study.models import StudyModel, scale_of
from sphericalvision.recipes.study.study_tables import Result, study_tables
from sphericalvision.recipes.study.training import Training
from sphericalvision.recipes.study.views import View
from sphericalvision.sphere.intake import unsigned
from sphericalvision.viz import sheet
from sphericalvision.viz.figure import figure_pixels
from sphericalvision.viz.panorama import icosphere_to_panorama, rgb_panorama

__all__ = ["Evaluated", "angle_plot", "panel_sheet", "report"]


HEADINGS = {
    "models": "Models",
    "table": "Errors by angle",
    "change": "Change with the angle",
    "where": "Where errors are",
    "inputs": "Equirectangular images without retraining",
    "details": "Other metrics",
}
"""Name of a table -> its heading on the page of all."""


class Evaluated(NamedTuple):
    """What was evaluated in one view.

    Attributes:
        view: rig and angle.
        samples: the frames.
        records: of each version of a model, by its name.
    """

    view: View
    samples: Dataset[Any]
    records: Mapping[str, Record]


def report(
    config: DictConfig,
    folder: Path,
    models: list[StudyModel],
    methods: list[Method],
    evaluated: list[Evaluated],
    trainings: list[Training],
    notes: list[str],
) -> list[dict[str, Any]]:
    """Write all tables and pictures to ``folder``, print the paper's table, and return the results.

    Returns:
        A dictionary for each view and method.
    """
    results = [_result(config, method, part) for part in evaluated for method in methods]
    tables = study_tables(results)
    for name, table in tables.items():
        table.save(folder / name, ".md", ".csv")
    write_image(folder / "errors_against_angle.png", angle_plot(results))
    fisheye = [part for part in evaluated if part.view.inputs == "fisheye"]
    columns = {f"{part.view.angle_deg:g} degrees": _drawn_frame(config, part, methods) for part in fisheye}
    write_image(folder / "panels.png", panel_sheet(columns))
    write_json(
        folder / "study.json",
        {
            "config": OmegaConf.to_container(config, resolve=True, throw_on_missing=False),
            "notes": notes,
            "trainings": [
                {"name": t.name, "words": t.words, "config": t.config} for t in trainings if t.is_done
            ],
            "results": results,
        },
    )
    shown = {"models": _model_table(models, methods, trainings, notes), **tables}
    headed = {heading: shown[name] for name, heading in HEADINGS.items() if name in shown}
    pictures = {"Error against angle": "errors_against_angle.png", "Depth maps": "panels.png"}
    save_report(folder, "study", "Study", headed, pictures)
    for name in ("table", "inputs"):
        if name in tables:
            tables[name].print()
    print(f"Results are in {folder}")
    return results


def _result(config: DictConfig, method: Method, part: Evaluated) -> dict[str, Any]:
    """What tables are made of: means over the frames of one view, and the errors of each by the paper's protocol."""
    record = part.records[method.name]
    errors = {name: values_of(record.frames, "paper", name) for name in ("MAE", "RMS")}
    return {
        "model": _model(method),
        "label": method.label,
        "seed": method.seed,
        **part.view._asdict(),
        "level": config.model.level,
        **scale_of(config)._asdict(),
        "num_frames": len(record.frames),
        "errors": record.means,
        "frames": {"names": list(record.frames), **errors},
    }


def _model(method: Method) -> str:
    """The name of the model whose seed a method is."""
    return method.name.partition("/")[0]


def _model_table(
    models: list[StudyModel], methods: list[Method], trainings: list[Training], notes: list[str]
) -> Table:
    """What each model is: parameters, and what it was trained on."""
    rows: list[Row] = []
    first = {_model(method): method for method in reversed(methods)}
    for model in models:
        if model.name not in first:
            continue
        mine = [training for training in trainings if training.model == model.name]
        parameters = None
        if model.kind == "depth_network":
            parameters = f"{sum(p.numel() for p in first[model.name].net.parameters()):,}"
        trained: list[str | None] = [None] * 4
        if mine:
            c = mine[0].config
            per_step = c["data.batch_size"] * (c.get("trainer.accumulate_grad_batches") or 1)
            frames = c.get("data.num_train")
            trained = [f"{c['trainer.max_steps']:,}", str(per_step)]
            trained += [f"{frames:,}" if frames else c.get("data.root"), str(len(mine))]
        rows.append([model.label, parameters, *trained])
    columns = ("model", "parameters", "steps", "frames a step", "training frames", "seeds")
    title = " ".join(["What was compared.", *(f"Not the same for all models: {note}." for note in notes)])
    return Table(title, columns, [rows])


def _drawn_frame(config: DictConfig, part: Evaluated, methods: list[Method]) -> DrawnFrame:
    """The frame that is drawn, seen at one angle, and what the first seed of every model estimates."""
    estimates: dict[str, Tensor] = {}
    for method in methods:
        estimates.setdefault(method.label, part.records[method.name].drawn[str(config.panel_frame)])
    batch = collate_samples([part.samples[config.panel_frame]])
    truth = Protocols(scale_of(config), config.model.level - 2).truth(batch)
    rig, height = batch["rig"].select(0), config.panel_height
    depth = icosphere_to_panorama(truth.inverse_depth[0].float(), height).reciprocal()
    images = {name: unsigned(image) for name, image in zip(rig.names, batch["fisheye"][0], strict=True)}
    colors, seen = rgb_panorama(rig, images, height, depth)
    view = color_picture(colors.where(seen, torch.tensor(0.6)))
    index = truth.indices[0].where(truth.valid[0], math.nan).float()
    return DrawnFrame(view, index, truth.counts[0], estimates, scale_of(config))


def angle_plot(results: Sequence[Result]) -> Picture:
    """MAE and the share of errors above 3 % against the angle, a line a model, bars over seeds; uint8 RGB."""
    results = [r for r in results if r["inputs"] == "fisheye"]
    number = results[0]["num_hypotheses"]
    figure = Figure(figsize=(9.6, 4.2), dpi=110)
    names = {"MAE": f"MAE (% of N = {number})", ">3": "points off by more than 3 % (%)"}
    for axes, (name, label) in zip(figure.subplots(1, 2), names.items(), strict=True):
        for model in dict.fromkeys(r["label"] for r in results):
            errors: dict[float, list[float]] = {}
            for r in results:
                if r["label"] == model:
                    errors.setdefault(r["angle_deg"], []).append(r["errors"]["paper"][name])
            cells = {angle: cell for angle in sorted(errors) if (cell := summarize(errors[angle]))}
            means, spreads = [c.mean for c in cells.values()], [c.spread or 0.0 for c in cells.values()]
            axes.errorbar([*cells], means, yerr=spreads, marker="o", markersize=4, capsize=3, label=model)
        axes.set(xlabel="cameras tilted down by θ (degrees)", ylabel=label)
        axes.set_xticks(sorted({r["angle_deg"] for r in results}))
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=min(len(labels), 4), frameon=False)
    bottom = 0.24 if len(labels) <= 4 else 0.3
    figure.subplots_adjust(left=0.07, right=0.99, top=0.97, bottom=bottom, wspace=0.2)
    return figure_pixels(figure)


def panel_sheet(columns: Mapping[str, DrawnFrame]) -> Picture:
    """View, truth and models by rows, angles by columns; what fewer than two cameras see is faded; uint8 RGB."""
    pictures = [
        [(f"{title}, {name}", picture) for name, picture in frame.depths().items()]
        for title, frame in columns.items()
    ]
    return sheet(dict(cell for row in zip(*pictures, strict=True) for cell in row), columns=len(columns))
