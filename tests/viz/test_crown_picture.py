# SPDX-License-Identifier: Apache-2.0
"""The sheet of a crown's ten rectangles."""

from __future__ import annotations

import numpy as np
import torch

from sphericalvision.crown import to_crown
from sphericalvision.viz import crown_picture


def test_all_ten_rectangles_are_on_the_sheet() -> None:
    crown = to_crown(torch.rand(1, 3, 162, generator=torch.Generator().manual_seed(0)))
    picture = crown_picture(crown, scale=8)
    windows = {}
    for direction, values in (("col", crown.col), ("row", crown.row)):
        for k, chart in enumerate(values[0]):
            tile = (chart.movedim(0, -1).numpy() * 255).round().astype(np.uint8).repeat(8, 0).repeat(8, 1)
            height, width = tile.shape[:2]
            corners = np.argwhere((picture == tile[0, 0]).all(-1))
            hits = [
                (int(y), int(x))
                for y, x in corners
                if np.array_equal(picture[y : y + height, x : x + width], tile)
            ]
            assert len(hits) == 1, (direction, k)
            windows[direction, k] = hits[0]
    for direction in ("col", "row"):
        tops = {windows[direction, k][0] for k in range(5)}
        lefts = [windows[direction, k][1] for k in range(5)]
        assert len(tops) == 1  # in a line
        assert lefts == sorted(lefts)  # in their order
