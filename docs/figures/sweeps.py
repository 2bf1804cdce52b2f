# SPDX-License-Identifier: Apache-2.0
"""Figures of the sphere sweep: its geometry, and the way from probabilities to depth and confidence."""

from __future__ import annotations

import math

import numpy as np
import torch
from matplotlib.patches import Circle

from figures import CHARTS, FAINT, INK, MARK, bare_axes, new_figure, to_html
from figures.results import scene_images, shipped
from sphericalvision.icosphere import Icosphere, icosphere_upsample
from sphericalvision.models.tried_hypotheses import two_modes
from sphericalvision.scenes import make_scene, ray_depth
from sphericalvision.sweep import index_from_depth, inverse_depth_hypotheses

__all__ = ["geometry", "probabilities"]

#: Turns the sweep's costs into probabilities for the picture.
SHARPNESS = 6.0


def geometry() -> str:
    """Two cameras, spheres of hypotheses, one direction, and what each camera sees at each guess."""
    figure = new_figure(8.8, 4.0)
    axes = bare_axes(figure, (0.0, 0.0, 0.56, 1.0))
    cameras = np.array([[-0.55, 0.0], [0.55, 0.0]])
    depths = 1 / inverse_depth_hypotheses(6, 0.85).numpy()[1:]
    depths = depths[depths < 4.6]
    angle = math.radians(62)
    ray = np.array([math.cos(angle), math.sin(angle)])
    truth = 1
    for number, depth in enumerate(depths):
        axes.add_patch(
            Circle(
                (0, 0),
                depth,
                fill=False,
                edgecolor=FAINT,
                linewidth=0.9,
                linestyle=(0, (4, 3)),
            )
        )
        place = math.radians(118 if number else 100)
        label = f"$d_{number + 1}$"
        axes.text(
            depth * math.cos(place),
            depth * math.sin(place),
            label,
            ha="center",
            va="bottom",
            fontsize=9,
        )
    axes.plot([0, 5 * ray[0]], [0, 5 * ray[1]], color=INK, linewidth=1.2)
    surface = depths[truth] * ray
    along = np.linspace(-0.75, 0.75, 40)
    axes.plot(
        surface[0] + along,
        surface[1] + 0.12 * np.sin(3 * along),
        color=CHARTS[0],
        linewidth=4,
        alpha=0.85,
    )
    axes.text(
        surface[0] + 0.85,
        surface[1] + 0.1,
        "surface",
        color=CHARTS[0],
        ha="left",
        va="center",
    )
    for k, camera in enumerate(cameras):
        for number, depth in enumerate(depths):
            point = depth * ray
            agree = number == truth
            axes.plot(
                [camera[0], point[0]],
                [camera[1], point[1]],
                color=MARK if agree else CHARTS[2],
                linewidth=1.9 if agree else 0.8,
                zorder=3 if agree else 1,
            )
        axes.add_patch(
            Circle(camera, 0.17, facecolor=CHARTS[1], edgecolor=INK, zorder=4)
        )
        axes.text(camera[0], camera[1] - 0.42, f"camera {k + 1}", ha="center")
    for depth in depths:
        axes.scatter(*(depth * ray), s=34, color="white", edgecolor=INK, zorder=5)
    axes.scatter(0, 0, s=14, color=INK)
    axes.text(0, -0.42, "rig", ha="center", color=INK)
    axes.set(xlim=(-2.6, 3.6), ylim=(-0.7, 4.3))

    chart = figure.add_axes((0.66, 0.17, 0.32, 0.62))
    agreement = np.array([0.55, 0.96, 0.42, 0.33, 0.28])[: len(depths)]
    chart.bar(
        range(1, len(depths) + 1),
        agreement,
        color=[MARK if n == truth else CHARTS[2] for n in range(len(depths))],
    )
    chart.set(
        xlabel="hypothesis",
        ylim=(0, 1),
        xticks=range(1, len(depths) + 1),
        yticks=[],
    )
    chart.set_xticklabels([f"$d_{n}$" for n in range(1, len(depths) + 1)])
    chart.set_title("do the cameras see the same?")
    return to_html(
        figure,
        "Two cameras look at points at five distances along one direction; they agree at the surface",
        "One direction of the rig, five hypotheses. At the true one both cameras look at the same point "
        "of the surface, and see the "
        "same; at the others they look at different points. (A drawing, not a measurement.)",
    )


def probabilities() -> str:
    """What sweep, prior and their fusion say at a textured, a bare and an edge vertex of one scene."""
    net, rig, tables = shipped()
    with torch.inference_mode():
        images, seen = net.views(scene_images("room", 11)[2], tables.seen)[0]
        clues = net.clues(images, tables, seen)
        fused = net.fuse(clues, images, seen, tables.offsets)
    scene = make_scene("room", 10_100_011)
    truth = index_from_depth(
        ray_depth(scene, rig.center, Icosphere(net.level - 1).vertices),
        16,
        net.min_depth,
    )
    tried = np.arange(clues.cost.shape[1]) / 2
    prior = clues.prior
    while prior.shape[-1] < clues.cost.shape[-1]:
        prior = icosphere_upsample(prior)
    sweep, prior, both = (
        values.softmax(1)[0]
        for values in (-SHARPNESS * clues.cost, prior, fused.logits)
    )
    answers = two_modes(fused.logits)
    second = both.where(
        torch.from_numpy(np.abs(tried[:, None] - answers[0].numpy())) > 1.5, 0.0
    ).amax(0)
    off = (answers[0][0] - truth).abs()
    places = {
        "texture: the sweep knows": (sweep.amax(0) - off).argmax(),
        "bare wall: the prior knows": (
            both.amax(0) - 3 * sweep.amax(0) - 4 * off
        ).argmax(),
        "edge: two answers": (
            second - 0.3 * (answers[0][0] - answers[1][0]).abs().sub(4).abs()
        ).argmax(),
    }
    figure = new_figure(8.8, 2.6)
    for k, (title, vertex) in enumerate(places.items()):
        axes = figure.add_axes((0.03 + 0.33 * k, 0.2, 0.29, 0.66))
        axes.set_title(title)
        axes.fill_between(
            tried,
            both[:, vertex],
            color=MARK,
            alpha=0.35,
            linewidth=0,
            label="fused",
        )
        axes.plot(tried, sweep[:, vertex], color=CHARTS[0], label="sweep")
        axes.plot(
            np.arange(prior.shape[0]),
            prior[:, vertex],
            color=CHARTS[2],
            label="prior",
        )
        axes.axvline(
            float(truth[vertex]),
            color=INK,
            linewidth=1,
            linestyle=":",
            label="truth",
        )
        axes.set(
            xlabel="index of the hypothesis",
            xticks=range(0, 16, 5),
            yticks=[],
            xlim=(0, 15),
            ylim=(0, None),
        )
        if k == 0:
            axes.legend(loc="upper right", fontsize=9)
    return to_html(
        figure,
        "Probabilities of the hypotheses at three vertices: of the sweep, of the prior, and of both fused",
        "Three vertices of one scene. Where there is texture the sweep's costs are sharp. On a bare "
        "wall they are flat, and the "
        "prior decides. At an edge two depths are likely: the result is the mean around the larger "
        "peak, not between them.",
    )
