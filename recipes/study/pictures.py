# SPDX-License-Identifier: Apache-2.0
"""The pictures of a study: error against angle, and depth maps of models by rows and angles by columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from sphericalvision.recipes.evaluation.pictures import DrawnFrame, Picture
from sphericalvision.recipes.evaluation.tables import summarize
from sphericalvision.recipes.study.tables import Result
from sphericalvision.viz import sheet
from sphericalvision.viz.figure import figure_pixels

__all__ = ["angle_plot", "panel_sheet"]


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
