# SPDX-License-Identifier: Apache-2.0
"""The pictures of a study: error against angle, and depth maps of models by rows and angles by columns."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from sphericalvision.recipes.evaluation.tables import summarize
from sphericalvision.recipes.study.tables import Result
from sphericalvision.sweep import depth_from_index
from sphericalvision.viz.color import DEPTH_MAP, depth_ticks, depth_to_color
from sphericalvision.viz.figure import figure_pixels
from sphericalvision.viz.panorama import icosphere_to_panorama

__all__ = ["PanelColumn", "angle_plot", "panel_sheet"]

Picture = npt.NDArray[Any]

DIMMED = 0.62
"""How far what fewer than two cameras see is faded to grey."""


class PanelColumn(NamedTuple):
    """One frame at one angle.

    Attributes:
        title: above it.
        color: uint8 ``(H, 2 * H, 3)``, the images as a panorama.
        truth: ``(V,)`` true index, NaN where unknown.
        shared: ``(V,)`` whether two or more cameras see the point.
        shared_panorama: ``(H, 2 * H)`` the same for pixels.
        estimates: label of a model -> index ``(V,)``, NaN where it says nothing.
    """

    title: str
    color: Picture
    truth: Tensor
    shared: Tensor
    shared_panorama: Tensor
    estimates: Mapping[str, Tensor]


def angle_plot(results: Sequence[Result]) -> Picture:
    """MAE and the share of errors above 3 % against the angle, a line a model, bars over seeds; uint8 RGB."""
    results = [r for r in results if r["inputs"] == "fisheye"]
    figure = Figure(figsize=(9.6, 4.2), dpi=110)
    for axes, name in zip(figure.subplots(1, 2), ("MAE", ">3"), strict=True):
        for label in dict.fromkeys(r["label"] for r in results):
            mine = [r for r in results if r["label"] == label]
            angles = sorted({r["angle_deg"] for r in mine})
            cells = [
                summarize(r["errors"]["paper"][name] for r in mine if r["angle_deg"] == a) for a in angles
            ]
            points = [
                (a, c.mean, c.spread or 0.0) for a, c in zip(angles, cells, strict=True) if c is not None
            ]
            if points:
                x, y, spread = zip(*points, strict=True)
                axes.errorbar(
                    x, y, yerr=spread, marker="o", markersize=4, capsize=3, linewidth=1.6, label=label
                )
        axes.set(xlabel="cameras tilted down by θ (degrees)", ylabel=_axis_label(name, results))
        axes.set_xticks(sorted({r["angle_deg"] for r in results}))
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=min(len(labels), 4), frameon=False)
    figure.subplots_adjust(
        left=0.07, right=0.99, top=0.97, bottom=0.24 if len(labels) <= 4 else 0.3, wspace=0.2
    )
    return figure_pixels(figure)


def _axis_label(name: str, results: Sequence[Result]) -> str:
    number = results[0]["num_hypotheses"]
    return f"MAE (% of N = {number})" if name == "MAE" else f"points off by more than {name[1:]} % (%)"


def panel_sheet(columns: Sequence[PanelColumn], num_hypotheses: int, min_depth: float) -> Picture:
    """Depth maps, models by rows and angles by columns, below the images and the truth; uint8 RGB.

    What fewer than two cameras see is faded and outlined; grey is unknown. Below each estimate stands its MAE.
    """
    labels = list(dict.fromkeys(label for column in columns for label in column.estimates))
    rows = ["images", "truth", *labels]
    figure = Figure(figsize=(0.5 + 3.3 * len(columns), 0.75 + 1.82 * len(rows)), dpi=110)
    grid = figure.subplots(len(rows), len(columns), squeeze=False)
    for k, column in enumerate(columns):
        grid[0, k].set_title(column.title, fontsize=11)
        grid[0, k].imshow(column.color, extent=(0, 2, 0, 1))
        maps = {"truth": column.truth, **column.estimates}
        for row, label in enumerate(rows[1:], 1):
            if label in maps:
                _draw_depth(grid[row, k], maps[label], column, num_hypotheses, min_depth)
            if label in column.estimates:
                grid[row, k].set_xlabel(
                    _frame_error(maps[label], column, num_hypotheses), fontsize=8, labelpad=2
                )
    for row, label in enumerate(rows):
        grid[row, 0].set_ylabel(label, fontsize=10)
        for axes in grid[row]:
            axes.set(xticks=[], yticks=[])
    figure.subplots_adjust(left=0.5 / figure.get_figwidth(), right=0.995, top=1 - 0.25 / figure.get_figheight(),
                           bottom=0.62 / figure.get_figheight(), wspace=0.03, hspace=0.13)  # fmt: skip
    _scale_bar(figure, min_depth)
    return figure_pixels(figure)


def _draw_depth(axes: Axes, index: Tensor, column: PanelColumn, number: int, nearest: float) -> None:
    height = len(column.shared_panorama)
    known = icosphere_to_panorama((~index.isnan()).float(), height) > 0.5
    depth = depth_from_index(icosphere_to_panorama(index.nan_to_num().clamp(min=0), height), number, nearest)
    colors = depth_to_color(depth.where(known, math.nan), nearest).astype(np.float64)
    hidden = ~column.shared_panorama.numpy()
    faded = hidden[..., None] * DIMMED
    axes.imshow((colors * (1 - faded) + 150.0 * faded).round().astype(np.uint8), extent=(0, 2, 0, 1))
    if hidden.any() and not hidden.all():
        x, y = (np.arange(2 * height) + 0.5) / height, 1 - (np.arange(height) + 0.5) / height
        axes.contour(x, y, hidden, levels=[0.5], colors="white", linewidths=1.1)


def _frame_error(index: Tensor, column: PanelColumn, number: int) -> str:
    counts = column.shared & ~column.truth.isnan() & ~index.isnan()
    error = (index - column.truth)[counts].abs().mean() * (100 / number)
    return f"MAE {float(error):.2f}"


def _scale_bar(figure: Figure, nearest: float) -> None:
    axes = figure.add_axes((0.25, 0.36 / figure.get_figheight(), 0.5, 0.12 / figure.get_figheight()))
    gradient = matplotlib.colormaps[DEPTH_MAP](np.linspace(0, 1, 512))[None, :, :3]
    axes.imshow(gradient, extent=(0, 1, 0, 1), aspect="auto", interpolation="nearest")
    ticks = depth_ticks(nearest)
    axes.set_yticks([])
    axes.set_xticks([position for position, _ in ticks], [text for _, text in ticks], fontsize=8)
    axes.set_xlabel(
        "depth (m); faded within white lines: seen by fewer than two cameras", fontsize=9, labelpad=1
    )
