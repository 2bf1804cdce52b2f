# SPDX-License-Identifier: Apache-2.0
"""What the network that ships makes of a scene: images, depth, confidence, points and failures."""

from __future__ import annotations

import functools
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from figures import FAINT, MARK, bar_below, bare_axes, new_figure, to_html
from figures.tables import read
from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.data import ToSphere
from sphericalvision.icosphere import Icosphere
from sphericalvision.models import RefinedSweepNet, pretrained
from sphericalvision.models.refinedsweepnet import RefinedTables
from sphericalvision.recipes.evaluation.tables import Table
from sphericalvision.scenes import make_scene, ray_depth, render_rig
from sphericalvision.sphere import Equirectangular, Resample
from sphericalvision.sweep import index_from_depth
from sphericalvision.viz import depth_to_color, rgb_panorama
from sphericalvision.viz.color import depth_ticks

__all__ = [
    "Result",
    "against_truth",
    "confidence",
    "failures",
    "hero",
    "reliability",
    "result",
    "scene_images",
    "shipped",
]

PANORAMA = Equirectangular(180, 360)
NEAR = 1.0  # metres, red
#: Scenes in which the network errs most, and why.
HARD = {
    ("polished", 1): "a mirror on the wall",
    ("plain", 5): "windows, and bars before them",
    ("floating", 5): "objects in front of each other",
    ("outdoors", 2): "thin poles before the sky",
}


class Result(NamedTuple):
    """A scene, what the cameras see, and what the network says."""

    rig: CameraRig
    pictures: dict[str, Tensor]
    colors: Tensor
    depth: Tensor
    true_depth: Tensor
    index: Tensor
    true_index: Tensor
    confidence: Tensor
    seen: Tensor


@functools.cache
def shipped() -> tuple[RefinedSweepNet, CameraRig, RefinedTables]:
    """The network that ships, four 220° fisheyes of 256 pixels, and the tables of both."""
    net, rig = (
        pretrained("refinedsweepnet"),
        ring_rig(4, 0.2, image_size=(256, 256)),
    )
    return net, rig, net.tables(rig)


@functools.cache
def to_panorama() -> Resample:
    """From the network's vertices."""
    return Resample(Icosphere(shipped()[0].level), PANORAMA)


@functools.cache
def scene_images(
    kind: str, seed: int
) -> tuple[CameraRig, dict[str, Tensor], Tensor]:
    """The rig, its photographs, and these on the network's icosphere, ``(1, 4, 3, V)``."""
    net, rig, _ = shipped()
    pictures = render_rig(make_scene(kind, 10_100_000 + seed), rig)
    return rig, pictures, ToSphere(net.image_level).images(pictures, rig)[None]


@functools.cache
def result(kind: str = "room", seed: int = 11) -> Result:
    """One scene, and the shipped network's answer, on a panorama."""
    net, _, tables = shipped()
    rig, pictures, images = scene_images(kind, seed)
    scene = make_scene(kind, 10_100_000 + seed)
    with torch.inference_mode():
        index, sure, seen = net.predict(images, tables)
    truth = ray_depth(scene, rig.center, PANORAMA.directions)
    shown = to_panorama()(torch.cat([index, sure, seen.float()]))
    depth = net.depth(shown[0])
    colors, _ = rgb_panorama(rig, pictures, PANORAMA.shape[0], depth)
    return Result(
        rig,
        pictures,
        colors,
        depth,
        truth,
        shown[0],
        index_from_depth(truth, net.num_hypotheses, net.min_depth),
        shown[1],
        shown[2] > 0.5,
    )


def draw_fisheyes(axes: Axes, pictures: dict[str, Tensor]) -> None:
    """The images in a square of two by two, without what lies around their circles."""
    views = list(pictures.values())
    rows = [torch.cat(views[:2], -1), torch.cat(views[2:], -1)]
    image = torch.cat(rows, -2).movedim(0, -1)
    side = image.shape[0] // 2
    place = (torch.arange(side) - (side - 1) / 2) / (side / 2)
    circle = (place[:, None] ** 2 + place**2 < 1).float().repeat(2, 2)
    axes.imshow(
        torch.cat([image, circle[..., None]], -1).clamp(0, 1),
        interpolation="antialiased",
    )


def draw_cloud(axes: Axes, shown: Result) -> None:
    """Points of the depth map from above and behind, without the ceiling."""
    points = (PANORAMA.directions * shown.depth[..., None]).reshape(-1, 3).numpy()
    colors = shown.colors.movedim(0, -1).reshape(-1, 3).clamp(0, 1).numpy()
    kept = (
        (points[:, 1] > -0.6)
        & (np.abs(points).max(1) < 6)
        & (shown.confidence.reshape(-1) > 0.5).numpy()
    )
    turn, tilt = np.radians(35), np.radians(38)
    x, y, z = points[kept].T
    right, away = (
        x * np.cos(turn) - z * np.sin(turn),
        x * np.sin(turn) + z * np.cos(turn),
    )
    up, towards = (
        -y * np.cos(tilt) + away * np.sin(tilt),
        -y * np.sin(tilt) - away * np.cos(tilt),
    )
    order = towards.argsort()
    axes.scatter(
        right[order],
        up[order],
        c=colors[kept][order],
        s=1.6,
        linewidths=0,
        rasterized=True,
    )


def depth_bar(figure: Figure, place: tuple[float, float, float, float]) -> None:
    """The scale of the depth maps here."""
    ticks = depth_ticks(NEAR, spacing=0.1)
    bar_below(figure, place, "turbo", "depth (m)", ticks)


def error_bar(
    figure: Figure, place: tuple[float, float, float, float], most: int
) -> None:
    """The scale of the maps of errors here."""
    ticks = [(k / most, str(k)) for k in range(most)] + [(1.0, f"≥ {most}")]
    bar_below(figure, place, "magma", "error of the index (hypotheses)", ticks)


def against_truth() -> str:
    """Estimated and true depth, and the error."""
    shown = result()
    figure = new_figure(8.8, 2.25)
    panels = {
        "estimated depth": depth_to_color(shown.depth, NEAR),
        "true depth": depth_to_color(shown.true_depth, NEAR),
        "error": (shown.index - shown.true_index).abs(),
    }
    for k, (title, values) in enumerate(panels.items()):
        axes = bare_axes(figure, (0.337 * k, 0.25, 0.326, 0.66), title)
        axes.imshow(values, cmap="magma", vmin=0, vmax=2)
    depth_bar(figure, (0.02, 0.21, 0.286, 0.05))
    depth_bar(figure, (0.357, 0.21, 0.286, 0.05))
    error_bar(figure, (0.694, 0.21, 0.286, 0.05), 2)
    return to_html(
        figure,
        "Estimated depth, true depth and the error of the index as panorama, each with its scale",
        "A scene that is not part of the training, beside its truth. One hypothesis is half a metre at a "
        "distance of two metres, and 12 cm at one metre.",
    )


def hero() -> str:
    """Input, depth and points of one scene."""
    shown = result()
    figure = new_figure(8.8, 5.6)
    draw_fisheyes(
        bare_axes(figure, (0.0, 0.47, 0.3, 0.47), "four 220° fisheye images"),
        shown.pictures,
    )
    axes = bare_axes(
        figure, (0.32, 0.53, 0.68, 0.43), "estimated depth, all around"
    )
    axes.imshow(depth_to_color(shown.depth, NEAR))
    depth_bar(figure, (0.39, 0.51, 0.54, 0.02))
    axes = bare_axes(figure, (0.0, 0.0, 0.46, 0.43))
    axes.imshow(shown.colors.movedim(0, -1).clamp(0, 1))
    axes = bare_axes(figure, (0.47, -0.01, 0.53, 0.43))
    draw_cloud(axes, shown)
    return to_html(
        figure,
        "Four fisheye images of a room, the estimated depth as a panorama, its colours, and its points from "
        "above",
        "A scene that is not part of the training. Below: the images as one panorama, and the estimated "
        "points from above, without the ceiling.",
    )


@functools.cache
def confidence() -> str:
    """Image, depth, error and confidence; then kept share against error."""
    shown = result()
    error = (shown.index - shown.true_index).abs()
    figure = new_figure(8.8, 2.6)
    for k, (values, title, most, colors) in enumerate(
        [(error, "error", 2, "magma"), (shown.confidence, "confidence", 1, "gray")]
    ):
        axes = bare_axes(figure, (0.355 * k, 0.19, 0.345, 0.72), title)
        axes.imshow(values, cmap=colors, vmin=0, vmax=most)
    error_bar(figure, (0.02, 0.16, 0.305, 0.045), 2)
    bar_below(
        figure,
        (0.375, 0.16, 0.305, 0.045),
        "gray",
        "confidence",
        [(k / 4, f"{k / 4:g}") for k in range(5)],
    )
    axes = figure.add_axes((0.78, 0.22, 0.2, 0.62))
    order = shown.confidence.flatten().argsort(descending=True)
    weights = PANORAMA.solid_angles.flatten()[order]
    mean = (error.flatten()[order] * weights).cumsum(0) / weights.cumsum(0)
    axes.plot(100 * weights.cumsum(0) / weights.sum(), mean, color=MARK)
    axes.set(
        xlabel="kept, % of the sphere",
        ylabel="mean error",
        ylim=(0, None),
        xlim=(0, 100),
    )
    return to_html(
        figure,
        "Error and confidence as panoramas, and the mean error of the surest share of all points",
        "The confidence is low (dark) where the error is large (bright). Without the fifth of lowest "
        "confidence, the mean error is smaller.",
    )


def reliability() -> str:
    """Expected against real errors by kind of scene, and the numbers folded away."""
    kinds = read("reliability")
    figure = new_figure(4.2, 3.4)
    axes = figure.add_axes((0.15, 0.15, 0.8, 0.82))
    axes.plot((0, 2), (0, 2), color=FAINT, linestyle="--")
    for kind, row in kinds.items():
        real, expected = zip(*filter(None, row["errors"]), strict=True)
        axes.plot(expected, real, "o-", markersize=3, linewidth=1.0, label=kind)
    axes.set(
        xlabel="error that the confidence says, hypotheses",
        ylabel="mean error",
        xlim=(0, 2),
        ylim=(0, 3.5),
    )
    axes.legend(fontsize=8, frameon=False, ncols=2)
    bounds = (0, 0.2, 0.4, 0.6, 0.8, 0.9, 1)
    bins = [f"{low:g} to {high:g}" for low, high in pairwise(bounds)]
    table = Table(
        "Errors in hypotheses by confidence; in brackets what the confidence says.",
        ("kind", "mean error, % of N", "surest 80 % / all", *bins),
        [
            [
                kind,
                row["mean"],
                row["surest"],
                *(f"{e[0]:.2f} ({e[1]:.2f})" if e else "–" for e in row["errors"]),
            ]
            for kind, row in kinds.items()
        ],
    )
    picture = to_html(
        figure,
        "Mean error against the error that the confidence says, a line for each kind of scene",
        "A point on the dashed line keeps its word; below it errors are smaller than it says.",
    )
    return f"{picture}\n<details><summary>The numbers</summary>\n{table.html()}</details>"


def failures() -> str:
    """Where the network errs most: image, answer, truth, error."""
    figure = new_figure(8.8, 1.42 * len(HARD) + 0.5)
    height = 1.42 / (1.42 * len(HARD) + 0.5)
    for row, ((kind, seed), why) in enumerate(HARD.items()):
        shown = result(kind, seed)
        bottom = 1 - (row + 1) * height
        error = (shown.index - shown.true_index.clamp(min=0)).abs()
        pictures = [
            (shown.colors.movedim(0, -1).clamp(0, 1), None, 1.0, why),
            (depth_to_color(shown.depth, NEAR), None, 1.0, "estimated"),
            (depth_to_color(shown.true_depth, NEAR), None, 1.0, "true"),
            (error, "magma", 4.0, "error"),
        ]
        for k, (values, colors, most, title) in enumerate(pictures):
            axes = bare_axes(
                figure, (0.25 * k + 0.003, bottom, 0.244, height * 0.84)
            )
            axes.set_title(title, fontsize=9)
            axes.imshow(values, cmap=colors, vmin=0, vmax=most)
    depth_bar(figure, (0.27, 0.065, 0.46, 0.018))
    error_bar(figure, (0.77, 0.065, 0.21, 0.018), 4)
    return to_html(
        figure,
        "Four scenes with large errors of the network: image, estimate, truth and error",
        "Scenes that are not part of the training, chosen because of their large errors.",
    )
