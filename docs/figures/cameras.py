# SPDX-License-Identifier: Apache-2.0
"""Figures of cameras: how the image grows with the angle, and what the cameras of a rig see."""

from __future__ import annotations

import functools
import math
from typing import Any

import torch
from matplotlib.colors import ListedColormap

from figures import CHARTS, FAINT, INK, bare_axes, new_figure, to_html
from sphericalvision.cameras import (
    AnglePolynomialCamera,
    AtanCamera,
    BrownConradyCamera,
    DivisionCamera,
    DoubleSphereCamera,
    ExtendedUnifiedCamera,
    FisheyeCamera,
    KannalaBrandtCamera,
    PinholeCamera,
    UnifiedCamera,
    ring_rig,
)
from sphericalvision.sphere import Equirectangular

__all__ = ["coverage", "radius_by_angle"]

SIZE, FOCAL = (4000, 4000), 400.0  # pixels


def _models() -> dict[str, Any]:
    one, middle = [FOCAL, FOCAL], [0.0, 0.0]
    widest = math.radians(140)
    return {
        "pinhole": PinholeCamera(one, middle, SIZE),
        "Brown-Conrady, k₁ = −0.1": BrownConradyCamera(
            one, middle, [-0.1, 0.0, 0.0, 0.0], SIZE
        ),
        "equidistant": FisheyeCamera(
            "equidistant", torch.tensor(FOCAL), torch.zeros(2), SIZE, widest
        ),
        "equisolid": FisheyeCamera(
            "equisolid", torch.tensor(FOCAL), torch.zeros(2), SIZE, widest
        ),
        "stereographic": FisheyeCamera(
            "stereographic", torch.tensor(FOCAL), torch.zeros(2), SIZE, widest
        ),
        "orthographic": FisheyeCamera(
            "orthographic", torch.tensor(FOCAL), torch.zeros(2), SIZE, math.pi / 2
        ),
        "Kannala-Brandt, k₁ = −0.03": KannalaBrandtCamera(
            one, middle, [-0.03, 0.0, 0.0, 0.0], SIZE, widest
        ),
        "unified, ξ = 1.2": UnifiedCamera(
            [2.2 * FOCAL] * 2, middle, 1.2, None, SIZE
        ),
        "extended unified, α = 0.6, β = 1.1": ExtendedUnifiedCamera(
            one, middle, 0.6, 1.1, SIZE
        ),
        "double sphere, ξ = −0.2, α = 0.6": DoubleSphereCamera(
            [0.8 * FOCAL] * 2, middle, -0.2, 0.6, SIZE
        ),
        "angle polynomial, k₂ = 0.05": AnglePolynomialCamera(
            one, middle, [0.0, 0.05], SIZE
        ),
        "ATAN, ω = 0.9": AtanCamera(one, middle, 0.9, SIZE),
        "division, λ₁ = −0.25": DivisionCamera(one, middle, [-0.25], SIZE),
    }


def radius_by_angle() -> str:
    """Distance from the image's centre against the angle from the axis, for every model."""
    figure = new_figure(8.8, 3.9)
    axes = figure.add_axes((0.07, 0.13, 0.52, 0.83))
    angle = torch.linspace(0, math.radians(140), 281)
    points = torch.stack([angle.sin(), torch.zeros_like(angle), angle.cos()], -1)
    for number, (name, camera) in enumerate(_models().items()):
        pixels, seen = camera.project(points)
        style = ("-", "--", ":")[number // len(CHARTS)]
        axes.plot(
            angle[seen].rad2deg(),
            pixels[seen, 0] / FOCAL,
            style,
            color=CHARTS[number % len(CHARTS)],
            label=name,
        )
    axes.axvline(90, color=FAINT, linewidth=1)
    axes.text(91.5, 0.15, "90°: beside the camera", color=INK, fontsize=9)
    axes.set(
        xlabel="angle from the optical axis, degrees",
        ylabel="radius / focal length",
        ylim=(0, 4),
        xlim=(0, 140),
    )
    figure.legend(loc="center left", bbox_to_anchor=(0.61, 0.5), fontsize=9)
    return to_html(
        figure,
        "Radius in the image against the angle from the axis for twelve camera models",
        "The image of a pinhole camera is infinitely large at 90°; that of a fisheye continues. A line "
        "ends where its model ends.",
    )


@functools.cache
def coverage() -> str:
    """How many cameras of a ring of four see each direction, level and tilted."""
    figure = new_figure(8.8, 2.75)
    colors = ListedColormap(["#3b3f46", "#b9c2ca", CHARTS[1], CHARTS[0], CHARTS[2]])
    panorama = Equirectangular(120, 240)
    for k, (title, view, tilt) in enumerate(
        (
            ("220°, level", 220, 0),
            ("220°, tilted by 30°", 220, 30),
            ("185°, level", 185, 0),
        )
    ):
        rig = ring_rig(4, 0.2, field_of_view=math.radians(view)).rotated(
            tilt=math.radians(tilt)
        )
        seen = rig.points_seen(
            panorama.directions.reshape(-1, 3), torch.tensor([1 / 3])
        )
        count = seen[:, 0].sum(0).reshape(panorama.shape)
        axes = bare_axes(figure, (0.335 * k, 0.2, 0.325, 0.72), title)
        picture = axes.imshow(
            count, cmap=colors, vmin=-0.5, vmax=4.5, interpolation="nearest"
        )
    bar = figure.colorbar(
        picture,
        cax=figure.add_axes((0.3, 0.2, 0.4, 0.04)),
        orientation="horizontal",
        ticks=range(5),
    )
    bar.outline.set_visible(False)
    bar.set_label("cameras that see a point 3 m away", fontsize=9)
    return to_html(
        figure,
        "Panoramas of how many cameras of a ring of four see each direction, for two fields of view "
        "and a tilt",
        "Depth needs two cameras. With 185° lenses, at most one sees straight up and down.",
    )
