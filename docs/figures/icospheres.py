# SPDX-License-Identifier: Apache-2.0
"""Figures of icospheres: levels, order of the vertices, charts, interpolation in a triangle."""

from __future__ import annotations

import functools
import math

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb

from figures import CHARTS, FAINT, INK, MARK, bare_axes, new_figure, to_html
from sphericalvision.crown import to_crown
from sphericalvision.icosphere import Icosphere

__all__ = ["draw_sphere", "interpolation", "levels", "seen_from", "vertex_order"]


def seen_from(
    points: torch.Tensor, elevation_deg: float = 28.0, turn_deg: float = 20.0
) -> np.ndarray:
    """Orthographic view: ``(*, 3)`` of right, up and towards the reader."""
    turn, tilt = math.radians(turn_deg), math.radians(elevation_deg)
    x, y, z = points.double().unbind(-1)
    right, away = (
        x * math.cos(turn) + z * math.sin(turn),
        z * math.cos(turn) - x * math.sin(turn),
    )
    up = -y  # y points down
    return torch.stack(
        [
            right,
            up * math.cos(tilt) + away * math.sin(tilt),
            up * math.sin(tilt) - away * math.cos(tilt),
        ],
        -1,
    ).numpy()


def draw_sphere(axes: Axes, level: int, elevation_deg: float = 28.0) -> np.ndarray:
    """An icosphere whose five charts have colours; gives the view's coordinates of its vertices."""
    ico = Icosphere(level)
    view = seen_from(ico.vertices, elevation_deg)
    corners = view[ico.faces.numpy()]
    chart = np.arange(len(corners)) * 5 // len(corners)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    normals *= np.sign((normals * corners.mean(1)).sum(-1, keepdims=True))
    front = normals[:, 2] > 0
    light = 0.72 + 0.28 * (normals @ np.array([-0.4, 0.6, 0.69])).clip(0, 1)
    colors = np.array([to_rgb(CHARTS[c]) for c in chart]) * light[:, None]
    axes.add_collection(
        PolyCollection(
            list(corners[front][..., :2]),
            facecolors=colors[front],
            edgecolors="white",
            linewidths=0.5,
        )
    )
    axes.set(xlim=(-1.08, 1.08), ylim=(-1.08, 1.08))
    return view


@functools.cache
def levels() -> str:
    """Levels 0 to 3."""
    figure = new_figure(8.6, 2.5)
    for level in range(4):
        axes = bare_axes(figure, (0.25 * level + 0.01, 0.0, 0.23, 0.86))
        axes.set_title(
            f"level {level}: {Icosphere(level).num_vertices} vertices", fontsize=9.5
        )
        draw_sphere(axes, level)
    return to_html(
        figure,
        "Four icospheres, from the icosahedron to 642 vertices, each in five colours",
        "Each level halves every edge. The five colours are the five charts.",
    )


def vertex_order() -> str:
    """One chart at levels 0 to 2, its vertices by number, new ones marked."""
    figure = new_figure(8.6, 4.0)
    for level in range(3):
        axes = bare_axes(
            figure, (0.33 * level + 0.01, 0.02, 0.31, 0.86), f"level {level}"
        )
        ids = (
            to_crown(
                torch.arange(Icosphere(level).num_vertices)[None, None].float()
            )
            .col[0, 0, 0]
            .int()
        )
        n = 2**level
        for i in range(2 * n + 1):
            for j in range(n + 1):
                for di, dj in ((1, 0), (0, 1), (-1, 1)):
                    if 0 <= i + di <= 2 * n and j + dj <= n:
                        axes.plot(
                            [j, j + dj],
                            [-i, -i - di],
                            color=FAINT,
                            linewidth=0.8,
                            zorder=1,
                        )
                old = i % 2 == 0 and j % 2 == 0
                owned = (0 < i <= 2 * n and j < n) or (i, j) in ((0, 0), (2 * n, n))
                color = CHARTS[0] if owned else "none"
                axes.scatter(
                    j,
                    -i,
                    s=200 / (level + 1),
                    color=color,
                    edgecolor=FAINT,
                    zorder=2,
                )
                weight = "bold" if old and level else "normal"
                axes.text(
                    j,
                    -i,
                    str(int(ids[i, j])),
                    ha="center",
                    va="center",
                    fontsize=8.5 - level,
                    weight=weight,
                )
        axes.set(
            xlim=(-0.3 * n - 0.4, 1.3 * n + 0.4),
            ylim=(-2.15 * n - 0.3, 0.15 * n + 0.3),
        )
    return to_html(
        figure,
        "Vertices of the first chart at levels 0, 1 and 2 as grids of numbers",
        "The first chart. The north pole is number 0, then the charts follow one by one, row by row, "
        "the south pole is the last. "
        "Filled vertices belong to this chart, the others to a neighbour. Bold ones are also vertices "
        "of the coarser level.",
    )


def interpolation() -> str:
    """Weights of the three vertices around a direction."""
    figure = new_figure(8.6, 3.0)
    axes = bare_axes(figure, (0.02, 0.02, 0.36, 0.96))
    view = draw_sphere(axes, 1)
    ico = Icosphere(1)
    direction = torch.nn.functional.normalize(
        torch.tensor([0.35, -0.45, -0.4]), dim=0
    )
    ids, weights = ico.locate(direction[None])
    spot = seen_from(direction)
    corners = view[ids[0].numpy()]
    axes.add_collection(
        PolyCollection(
            [corners[:, :2]], facecolors="none", edgecolors=INK, linewidths=1.8
        )
    )
    axes.scatter(*spot[:2], color="white", edgecolor=INK, s=28, zorder=4)
    near = bare_axes(figure, (0.42, 0.04, 0.26, 0.92))
    flat = np.array([[0.0, 0.0], [1.0, 0.0], [0.5, math.sqrt(0.75)]])
    inside = (weights[0].numpy()[:, None] * flat).sum(0)
    for k in range(3):
        rest = [flat[m] for m in range(3) if m != k]
        near.add_collection(
            PolyCollection(
                [np.array([inside, *rest])],
                facecolors=CHARTS[k],
                alpha=0.55,
                edgecolors="white",
            )
        )
        away = flat[k] + np.array([0.0, 0.13 if k == 2 else -0.16])
        near.text(
            *away, f"$w_{k + 1}$ = {weights[0, k]:.2f}", ha="center", va="center"
        )
        near.scatter(*flat[k], color=CHARTS[k], s=70, zorder=3, edgecolor="white")
    near.scatter(*inside, color="white", edgecolor=INK, s=50, zorder=4)
    near.set(xlim=(-0.25, 1.25), ylim=(-0.2, 1.1))
    figure.text(0.71, 0.62, "value = $w_1 v_1 + w_2 v_2 + w_3 v_3$", fontsize=11)
    figure.text(
        0.71,
        0.42,
        "Each weight is the share of the\ntriangle opposite to its vertex,\nin its colour.",
        color=INK,
    )
    figure.text(0.71, 0.3, "They sum to one.", color=MARK)
    return to_html(
        figure,
        "A direction in a triangle of the icosphere, and the three weights of its corners",
        "Linear interpolation in the triangle that contains the direction.",
    )
