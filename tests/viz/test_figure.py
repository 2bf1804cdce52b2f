# SPDX-License-Identifier: Apache-2.0
"""Sheets and scale bars keep the pixels of the pictures they hold."""

import numpy as np
import pytest

from sphericalvision.viz.figure import add_scale_bar, sheet, strip

TICKS = [(0.0, "∞"), (1.0, "0.5")]


def noise(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)


def test_a_scale_bar_leaves_the_picture_alone() -> None:
    picture = noise(320, 641)
    result = add_scale_bar(picture, "turbo", TICKS, "depth (m)")
    assert result.shape[1] == 641
    np.testing.assert_array_equal(result[:320], picture)
    bar = result[320:]
    left, right = bar[12, 25].astype(int), bar[12, -25].astype(int)
    assert left[2] > left[0]  # far, blue
    assert right[0] > right[2]  # near, red
    assert (bar[20:] < 100).any()  # ticks and label are written


def test_narrow_pictures_are_enlarged_without_mixing_pixels() -> None:
    picture = noise(10, 160)
    result = add_scale_bar(picture, "turbo", TICKS, "depth (m)")
    np.testing.assert_array_equal(result[:40:4, ::4], picture)
    np.testing.assert_array_equal(result[3:40:4, 3::4], picture)


def test_a_sheet_holds_each_picture_once_in_its_cell() -> None:
    wide, tall = noise(20, 60), noise(50, 30)
    page = sheet([wide, tall, wide], columns=2, gap=10)
    assert page.shape == (10 + 50 + 10 + 20 + 10, 10 + 60 + 10 + 30 + 10, 3)
    np.testing.assert_array_equal(page[10:30, 10:70], wide)
    np.testing.assert_array_equal(page[10:60, 80:110], tall)
    np.testing.assert_array_equal(page[70:90, 10:70], wide)


def test_titles_get_a_line_of_their_own() -> None:
    picture = noise(20, 200)
    page = sheet({"a title": picture}, gap=0)
    assert page.shape == (44, 200, 3)
    np.testing.assert_array_equal(page[24:], picture)
    assert (page[:24] < 128).any()


@pytest.mark.parametrize("number", [1, 2, 3, 4, 5, 6, 7, 12, 13])
def test_a_strip_has_no_place_left_over(number: int) -> None:
    page = strip([np.full((30 + k, 40, 3), 10 * k, np.uint8) for k in range(number)], width=800, gap=10)
    assert page.shape[1] == 800
    rows = -(-number // 6)
    assert (page == 255).all(-1).all(-1).sum() == 10 * (rows - 1)  # between rows alone
    for row in np.array_split(np.arange(number), rows):
        line = page[int((row[0] > 0) * (page.shape[0] / 2 + 20))]
        assert (line == 255).all(-1).sum() == 10 * (len(row) - 1)  # between pictures alone
