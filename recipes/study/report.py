# SPDX-License-Identifier: Apache-2.0
"""The tables and pictures of the paper's study."""

import math
from collections.abc import Mapping

import numpy as np
import torch
from matplotlib.figure import Figure
from omegaconf import DictConfig
from torch import Tensor

from sphericalvision.io.images import as_bytes
from sphericalvision.metrics import DepthIndexError
from sphericalvision.recipes.evaluation.loop import SampleFrames
from sphericalvision.recipes.evaluation.methods import Method
from sphericalvision.recipes.evaluation.pictures import DrawnFrame, Picture, camera_picture
from sphericalvision.recipes.evaluation.protocols import Protocols
from sphericalvision.recipes.evaluation.records import Record
from sphericalvision.recipes.evaluation.results import Column, Results
from sphericalvision.recipes.evaluation.tables import Table
from sphericalvision.recipes.study.models import scale_of
from sphericalvision.recipes.study.tilted_views import View
from sphericalvision.sphere.intake import unsigned
from sphericalvision.viz.figure import figure_pixels
from sphericalvision.viz.panorama import icosphere_to_panorama, rgb_panorama

PAPER: tuple[Column, ...] = tuple((name, f"paper {name}", 2) for name in DepthIndexError.error_names)
DETAILS: tuple[Column, ...] = (
    ("AbsRel", "depth AbsRel", 3),
    ("RMSE (m)", "depth RMSE", 2),
    ("d<1.25", "depth d<1.25", 3),
    ("MAE by solid angle", "solid_angle MAE", 2),
    ("OmniMVS protocol MAE", "omnimvs MAE", 2),
    ("MAE at seams", "seam MAE", 2),
    ("MAE off seams", "off_seam MAE", 2),
    ("MAE, nothing left out", "all MAE", 2),
    ("left out (%)", "points left_out", 1),
)
WHERE: tuple[Column, ...] = (
    ("above 30°", "above MAE", 2),
    ("within 30°", "around MAE", 2),
    ("below −30°", "below MAE", 2),
    ("2 cameras", "two MAE", 2),
    ("3 cameras", "three MAE", 2),
    ("4 or more", "four MAE", 2),
)


def study_tables(results: Results, config: DictConfig, views: list[View]) -> dict[str, Table]:
    """All tables by the names of their files; the table of inputs where there are equirectangular ones.

    * ``table``: the paper's, ``>1 >3 >5 MAE RMS`` of each model at each angle;
    * ``change``: MAE at each angle, and over the MAE of the same seed at the first;
    * ``where``: MAE by latitude and by the number of cameras that see a point: where a model suffers from the angle;
    * ``inputs``: the same networks on fisheye images and on equirectangular images of the same scenes;
    * ``details``: the other protocols.
    """
    angles = {f"{view.angle_deg:g}°": view.name for view in views if view.inputs == "fisheye"}
    left_out = [
        f"{results.means(results.labels[0], 'points left_out', name)[0]:.1f} % at {angle}"
        for angle, name in angles.items()
    ]
    number = f"N = {config.num_hypotheses}"
    frames = len(next(iter(results.records[views[0].name].values())).frames)
    seeds = len({method.seed for method in results.methods} - {None})
    spread = f"mean ± standard deviation over {seeds} seeds" if seeds > 1 else "one seed"
    about = (
        f"{frames} frames, vertices of level {config.model.level - 2} that two or more cameras see, {spread}"
    )
    level = {view.inputs: view.name for view in views if view.angle_deg == 0}
    tables = {
        "table": results.by_set(
            f"Percent of {number}; {about}. Left out, as fewer cameras see it: {', '.join(left_out)}.",
            "θ",
            angles,
            PAPER,
        ),
        "change": results.against(f"MAE in percent of {number}, and ratios; {about}.", "paper MAE", angles),
        "where": results.by_set(
            f"MAE in percent of {number} by latitude and by cameras that see a point; {about}.",
            "θ",
            angles,
            WHERE,
        ),
        "inputs": results.by_set(
            f"Percent of {number}, networks trained on fisheye images alone; {about}.", "images", level, PAPER
        ),
        "details": results.by_set(
            f"MAE in percent of {number}, but for that of the OmniMVS protocol (panorama within 45° of the "
            f"horizon, N = 192); depths up to 100 m; {about}. Left out: points that fewer than two cameras see.",
            "θ",
            angles,
            DETAILS,
        ),
    }
    return {name: table for name, table in tables.items() if name != "inputs" or "equirect" in level}


def drawn_frame(
    config: DictConfig, frames: SampleFrames, methods: list[Method], records: Mapping[str, Record]
) -> DrawnFrame:
    """The frame that is drawn, seen at one angle, and what the first seed of every model estimates."""
    estimates: dict[str, Tensor] = {}
    for method in methods:
        estimates.setdefault(method.label, records[method.name].drawn[str(config.panel_frame)])
    ((_, batch),) = frames.batches([str(config.panel_frame)])
    truth = Protocols(scale_of(config), config.model.level - 2).truth(batch)
    rig, height = batch["rig"].select(0), config.panel_height
    depth = icosphere_to_panorama(truth.inverse_depth[0].float(), height).reciprocal()
    images = {name: unsigned(image) for name, image in zip(rig.names, batch["fisheye"][0], strict=True)}
    colors, seen = rgb_panorama(rig, images, height, depth)
    view = as_bytes(colors.where(seen, torch.tensor(0.6)))
    index = truth.indices[0].where(truth.regions["all"][0], math.nan).float()
    camera = camera_picture(images[rig.names[0]], height)
    return DrawnFrame(camera, view, index, truth.regions["paper"][0], estimates, scale_of(config))


def angle_plot(results: Results, views: list[View], num_hypotheses: int) -> Picture:
    """MAE and the share of errors above 3 % against the angle, a line a model, bars over seeds; uint8 RGB."""
    angles = {view.angle_deg: view.name for view in views if view.inputs == "fisheye"}
    figure = Figure(figsize=(9.6, 4.2), dpi=110)
    names = {"MAE": f"MAE (% of N = {num_hypotheses})", ">3": "points off by more than 3 % (%)"}
    for axes, (name, label) in zip(figure.subplots(1, 2), names.items(), strict=True):
        for model in results.labels:
            seeds = np.array([results.means(model, f"paper {name}", view) for view in angles.values()])
            spreads = seeds.std(1, ddof=min(1, seeds.shape[1] - 1))  # 0 of a single seed
            axes.errorbar([*angles], seeds.mean(1), spreads, marker="o", markersize=4, capsize=3, label=model)
        axes.set(xlabel="cameras tilted down by θ (degrees)", ylabel=label)
        axes.set_xticks([*angles])
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=min(len(labels), 4), frameon=False)
    bottom = 0.24 if len(labels) <= 4 else 0.3
    figure.subplots_adjust(left=0.07, right=0.99, top=0.97, bottom=bottom, wspace=0.2)
    return figure_pixels(figure)
