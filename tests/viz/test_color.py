# SPDX-License-Identifier: Apache-2.0
"""Colours follow inverse depth, ends and unknowns are what the docstrings say."""

import math

import matplotlib
import numpy as np
import pytest
import torch

from sphericalvision.viz.color import UNKNOWN_GREY, depth_ticks, depth_to_color, error_to_color, near_end


def test_depth_colours_are_even_in_inverse_depth() -> None:
    position = np.linspace(0, 1, 256)
    near, far = 1 / 0.5, 1 / 10.0
    depth = torch.from_numpy(1 / (far + position * (near - far)))
    expected = (np.array(matplotlib.colormaps["turbo"](position))[:, :3] * 255).round()
    difference = np.abs(depth_to_color(depth, 0.5, 10.0) - expected)
    assert difference.max() <= 6  # a value on the edge of two of the 256 colours may take either


def test_ends_saturate_and_unknown_is_grey() -> None:
    depth = torch.tensor([0.5, 0.1, 10.0, 99.0, math.inf, math.nan, 0.0, -1.0])
    colors = depth_to_color(depth, 0.5, 10.0)
    assert (colors[0] == colors[1]).all()
    assert (colors[2] == colors[3]).all()
    assert (colors[2] == colors[4]).all()
    assert (colors[5:] == UNKNOWN_GREY).all()
    assert colors[0, 0] > colors[0, 2]  # near is red
    assert colors[2, 0] < colors[2, 2]  # far is blue


def test_errors_grow_brighter() -> None:
    brightness = error_to_color(torch.linspace(0, 5, 50), 5.0).sum(-1)
    assert (np.diff(brightness.astype(int)) >= 0).all()
    assert (error_to_color(torch.tensor([math.nan]), 5.0) == UNKNOWN_GREY).all()


@pytest.mark.parametrize(("near", "far"), [(0.55, math.inf), (1.65, 30.0), (0.013, 0.02), (5.0, math.inf)])
def test_ticks_stand_where_the_colour_of_their_depth_is(near: float, far: float) -> None:
    ticks = depth_ticks(near, far)
    positions = np.array([position for position, _ in ticks])
    assert positions[0] == 1
    assert positions[-1] == 0
    assert (-np.diff(positions) >= 0.07 - 1e-12).all()
    for position, label in ticks:
        depth = math.inf if label == "∞" else float(label)
        assert position == pytest.approx((1 / depth - 1 / far) / (1 / near - 1 / far), abs=0.02)


def test_the_red_end_is_round_near_what_is_nearest_and_not_nearer_than_what_is_tried() -> None:
    depth = torch.linspace(0.9, 30.0, 5000)
    depth[:10] = 0.2  # a few wrong ones do not count
    assert near_end(depth, 0.1) == pytest.approx(1.0)  # 1.2 m is the first percentile
    for scale in (0.01, 0.37, 5.0, 1000.0):
        near = near_end(scale * depth, 1e-4)
        nearest = float((scale * depth).quantile(0.01))
        assert 0.75 * nearest <= near <= nearest
    assert near_end(depth, 3.0) == 3.0
    assert near_end(torch.full((5,), math.nan), 0.4) == 0.4
