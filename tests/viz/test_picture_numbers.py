# SPDX-License-Identifier: Apache-2.0
"""What pictures, meshes and drawings are made of, with their defaults: one number each."""

import importlib
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from sphericalvision.viz import angle_map, coverage_panorama, rig_picture
from tests.laws.cameras import uneven_rig
from tests.values import coarse_sum, numbers_in, rand, sum_of, tensors_of, weighted_sum

RIG = uneven_rig()
IMAGES = {name: rand(3, 36, 50, seed=k) for k, name in enumerate(RIG.names)}
DEPTH, BUMPY = 0.3 + 4 * rand(20, 40, seed=9), 0.5 + rand(162)


def picture(values: Any) -> float:
    return coarse_sum(torch.from_numpy(np.array(values)).movedim(-1, 0).double() / 255)


def noise(height: int, width: int, seed: int = 0) -> Any:
    return (255 * rand(height, width, 3, seed=seed)).byte().numpy()


def mesh(shape: Any) -> Any:
    return shape.vertices, shape.faces / 100, np.asarray(shape.visual.vertex_colors)[:, :3] / 255


MODULES = "viz.color viz.figure viz.panorama"
"""Where names of the table come from, besides those that are public."""

NUMBERS = """
picture(depth_to_color(DEPTH, 0.5, 4.0)), picture(depth_to_color(DEPTH, 0.5)) -> 0.0474
picture(error_to_color(DEPTH - 2, 2.5)) -> 0.1037
depth_ticks(0.55), depth_ticks(1.0, 9.0), depth_ticks(1.0, 9.0, 0.2) -> -2.7928
picture(fade(noise(8, 12), 1.2 * rand(8, 12))), confidence_strength(rand(50), rand(50, seed=1) > 0.2) -> 0.2938
[near_end(10.0**k * DEPTH, 1e-3) / 10.0**k for k in range(-1, 3)] -> -0.4558
picture(depth_panorama(DEPTH, 0.5)), picture(depth_panorama(DEPTH, 0.5, 4.0, rand(20, 40))) -> 1.9457
picture(error_panorama(DEPTH - 2, 2.5)), picture(strip([noise(20 + k, 30, k) for k in range(8)], 170)) -> -0.3018
picture(sheet({"one": noise(20, 90), "a longer title": noise(30, 64, 1), "": noise(9, 40)}, 2)) -> -0.5174
picture(sheet([noise(9, 40)])) -> 0.1188
mesh(icosphere_mesh(BUMPY, rand(3, 162))), mesh(icosphere_mesh(BUMPY)) -> -3.1096
mesh(sphere_mesh(BUMPY)), mesh(sphere_mesh(rand(3, 162), 0.7)) -> 4.3005
icosphere_to_panorama(rand(2, 162), 9) -> -0.8180
rgb_panorama(RIG, IMAGES, 20, DEPTH), rgb_panorama(RIG, IMAGES, 20), rgb_panorama(RIG, IMAGES, 9, 0.4) -> 2.0537
"""
"""A call -> the sum over the numbers in its result, each weighted by where it stands."""


@pytest.mark.parametrize(("call", "expected"), numbers_in(NUMBERS))
def test_numbers_stay(call: str, expected: float) -> None:
    assert sum_of(call, globals(), MODULES) == pytest.approx(expected, abs=2e-3)


def drawn(function: Callable[..., Any], *arguments: Any, monkeypatch: pytest.MonkeyPatch) -> float:
    """Of all lines, areas, images and numbers in the texts of a figure; what a renderer makes of them is its own."""
    monkeypatch.setattr(importlib.import_module(function.__module__), "figure_pixels", lambda figure: figure)
    numbers: list[Any] = []
    for axes in (figure := function(*arguments)).axes:
        for line in axes.lines:
            numbers += [
                line.get_data_3d() if hasattr(line, "get_data_3d") else line.get_data(),
                line.get_linewidth(),
            ]
        numbers += [patch.get_xy() for patch in axes.patches]
        numbers += [(np.ma.filled(image.get_array(), -1.0), image.get_extent()) for image in axes.images]
        numbers += [axes.get_xlim(), axes.get_ylim(), axes.get_position().bounds]
        numbers += [text.get_position()[:2] for text in axes.texts]
        legend = axes.get_legend().get_texts() if axes.get_legend() else []
        texts = [text.get_text() for text in (*axes.texts, *legend, axes.title, axes.xaxis.label)]
        numbers += [float(number) for text in texts for number in re.findall(r"\d+\.?\d*", text)]
    numbers += [float(number) for number in re.findall(r"\d+\.?\d*", figure.get_suptitle())]
    return weighted_sum(*tensors_of(numbers))


DRAWINGS: dict[str, tuple[Callable[..., Any], tuple[Any, ...], float]] = {
    "angles": (angle_map, (RIG.cameras["a"],), -535.1012),
    "angles on an image": (angle_map, (RIG.cameras["b"], IMAGES["b"], RIG.masks["b"], "b"), 156.8670),
    "rig": (rig_picture, (RIG,), -8.4152),
    "coverage": (coverage_panorama, (RIG,), -98.2100),
    "coverage nearby": (coverage_panorama, (RIG, 0.6, 30, "nearby"), -114.7087),
}
"""What is drawn, of what, and the sum over it."""


@pytest.mark.parametrize("name", DRAWINGS)
def test_drawings_stay(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    function, arguments, expected = DRAWINGS[name]
    assert drawn(function, *arguments, monkeypatch=monkeypatch) == pytest.approx(expected, abs=2e-3)
