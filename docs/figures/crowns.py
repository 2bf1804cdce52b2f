# SPDX-License-Identifier: Apache-2.0
"""Figures of the crown: how a ball becomes ten rectangles, and what a tap of a convolution touches."""

from __future__ import annotations

import functools
import math

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch

from figures import CHARTS, FAINT, INK, MARK, bare_axes, new_figure, to_html
from figures.icospheres import draw_sphere, seen_from
from sphericalvision.crown import to_crown
from sphericalvision.crown.taps import COL_TAPS, ROW_TAPS
from sphericalvision.icosphere import Icosphere

__all__ = ["taps", "unfolding"]

DOWN = math.sqrt(0.75)


def net_place(chart: float, i: float, j: float) -> tuple[float, float]:
    """Where vertex (i, j) of a chart lies in the flat net of the icosahedron; i and j in edges of it."""
    return chart + (j - i) / 2, -DOWN * (i + j)


def triangles(rows: int, columns: int) -> list[list[tuple[int, int]]]:
    """Triangles of a grid of triangles, as corners (i, j)."""
    found = []
    for i in range(rows):
        for j in range(columns):
            found += [
                [(i, j), (i + 1, j), (i, j + 1)],
                [(i + 1, j), (i + 1, j + 1), (i, j + 1)],
            ]
    return found


def draw_net(axes: Axes, rows_marked: bool) -> None:
    """The net of the icosahedron: five strips side by side; one column, or one row, has a frame."""
    for chart in range(5):
        faces = [
            [net_place(chart, i, j) for i, j in face] for face in triangles(2, 1)
        ]
        axes.add_collection(
            PolyCollection(
                faces, facecolors=CHARTS[chart], edgecolors="white", linewidths=1.0
            )
        )
        axes.text(*net_place(chart, -0.12, -0.12), "N", ha="center", fontsize=8)
        axes.text(
            *net_place(chart, 2.12, 1.22), "S", ha="center", va="center", fontsize=8
        )
    if rows_marked:
        frame = [(1, 0, 0), (1, 1, 0), (1, 1, 2), (1, 0, 2)]
    else:
        frame = [(1, 0, 0), (1, 2, 0), (1, 2, 1), (1, 0, 1)]
    axes.add_collection(
        PolyCollection(
            [[net_place(*corner) for corner in frame]],
            facecolors="none",
            edgecolors=INK,
            linewidths=2.2,
        )
    )
    axes.set(xlim=(-1.15, 5.15), ylim=(-3 * DOWN - 0.35, 0.35))


def draw_rectangle(
    axes: Axes, rows: int, columns: int, chart_of: list[int], scale: int = 4
) -> None:
    """A rectangle of the crown, its triangles half squares; ``chart_of`` names the chart of "
    "each unit square."""
    for square, chart in enumerate(chart_of):
        top, left = (square, 0) if rows > columns else (0, square)
        faces = [
            [((left + j / scale), -(top + i / scale)) for i, j in face]
            for face in triangles(scale, scale)
        ]
        axes.add_collection(
            PolyCollection(
                faces, facecolors=CHARTS[chart], edgecolors="white", linewidths=0.35
            )
        )
    axes.set(xlim=(-0.1, columns + 0.1), ylim=(-rows - 0.1, 0.1))


def arrow(
    figure: Figure, start: tuple[float, float], end: tuple[float, float]
) -> None:
    """An arrow between two places of the figure."""
    patch = FancyArrowPatch(
        start,
        end,
        transform=figure.transFigure,
        arrowstyle="-|>",
        mutation_scale=14,
        color=INK,
        linewidth=1.4,
    )
    figure.add_artist(patch)


@functools.cache
def unfolding() -> str:
    """Ball, net, columns and rows."""
    figure = new_figure(8.8, 5.2)
    ball = bare_axes(figure, (0.0, 0.3, 0.24, 0.42), "icosphere")
    draw_sphere(ball, 2)
    for k, (rows_marked, bottom) in enumerate(((False, 0.53), (True, 0.03))):
        net = bare_axes(
            figure,
            (0.29, bottom, 0.4, 0.42),
            "" if k else "flat net, cut open from pole to pole",
        )
        draw_net(net, rows_marked)
    arrow(figure, (0.235, 0.56), (0.3, 0.7))
    arrow(figure, (0.235, 0.46), (0.3, 0.3))
    for chart in range(5):
        column = bare_axes(figure, (0.745 + 0.05 * chart, 0.6, 0.045, 0.3))
        draw_rectangle(column, 2, 1, [chart, chart])
        row = bare_axes(figure, (0.755, 0.365 - 0.085 * chart, 0.12, 0.085))
        draw_rectangle(row, 1, 2, [chart, (chart + 1) % 5])
    arrow(figure, (0.69, 0.75), (0.735, 0.75))
    arrow(figure, (0.69, 0.24), (0.735, 0.24))
    figure.text(0.865, 0.93, "five columns", ha="center")
    figure.text(0.89, 0.24, "five rows", ha="left")
    return to_html(
        figure,
        "An icosphere, its net with one column and one row framed, and the ten rectangles of the crown",
        "A column is one chart from pole to pole, a row the northern half of a chart and the "
        "southern half of the next. "
        "Sheared so that the triangles become half squares, both are rectangles. N and S are the "
        "poles; what is cut at the "
        "border of a column is inside a row.",
    )


def taps() -> str:
    """The seven taps on rectangles and on the sphere, at a vertex inside and at one with five neighbours."""
    figure = new_figure(8.8, 2.9)
    for kind, (name, places_of_taps) in enumerate(
        {"columns": COL_TAPS, "rows": ROW_TAPS}.items()
    ):
        flat = bare_axes(
            figure, (0.005 + 0.2 * kind, 0.04, 0.19, 0.84), f"on {name}"
        )
        flat.scatter(
            [j for _ in range(5) for j in range(-2, 3)],
            [i for i in range(-2, 3) for _ in range(5)],
            s=9,
            color=FAINT,
        )
        for i, line in enumerate(places_of_taps, start=-1):
            for j, tap in enumerate(line, start=-1):
                if tap > 6:
                    flat.text(
                        j,
                        -i - 0.03,
                        "×",
                        ha="center",
                        va="center",
                        fontsize=14,
                        color=FAINT,
                    )
                    continue
                flat.plot([0, j], [0, -i], color=MARK, linewidth=1.4, zorder=1)
                flat.scatter(
                    j, -i, s=150, color=MARK if tap < 6 else CHARTS[0], zorder=2
                )
                flat.text(
                    j,
                    -i - 0.03,
                    str(tap),
                    ha="center",
                    va="center",
                    color="white",
                    fontsize=8.5,
                )
        flat.set(xlim=(-2.3, 2.3), ylim=(-2.3, 2.3))
    ico = Icosphere(3)
    ids = (
        to_crown(torch.arange(ico.num_vertices)[None, None].float())
        .col[0, :, 0]
        .long()
    )
    view = seen_from(ico.vertices)
    places = [
        (6, 4, "on the sphere: six neighbours"),
        (8, 0, "at one of twelve: five"),
    ]
    for k, (i, j, title) in enumerate(places):
        axes = bare_axes(figure, (0.415 + 0.295 * k, 0.02, 0.285, 0.86), title)
        draw_sphere(axes, 3)
        visible = [c for c in range(5) if view[ids[c, i, j], 2] > 0.3]
        center = int(ids[max(visible, key=lambda c: view[ids[c, i, j], 2]), i, j])
        neighbors = [int(v) for v in ico.neighbors[center] if v >= 0]
        ring = np.array([view[v, :2] for v in neighbors])
        for end in ring:
            axes.plot(
                [view[center, 0], end[0]],
                [view[center, 1], end[1]],
                color=INK,
                linewidth=1.6,
            )
        axes.scatter(
            ring[:, 0], ring[:, 1], s=34, color="white", edgecolor=INK, zorder=3
        )
        axes.scatter(*view[center, :2], s=50, color=INK, zorder=3)
        middle = view[center, :2]
        axes.set(
            xlim=(middle[0] - 0.55, middle[0] + 0.55),
            ylim=(middle[1] - 0.55, middle[1] + 0.55),
        )
    return to_html(
        figure,
        "The seven taps of a hexagonal convolution on a grid and on the sphere",
        "Seven weights: the vertex (6) and its neighbours (0 to 5). Two corners of the 3 x 3 window "
        "stay empty. On rows the same "
        "taps are rotated by 60°.",
    )
