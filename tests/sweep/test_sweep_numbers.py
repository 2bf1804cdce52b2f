# SPDX-License-Identifier: Apache-2.0
"""Each function of the room, with its defaults, on a rig, masks and values that have no symmetry: one number each."""

from __future__ import annotations

from typing import Any

import pytest

from sphericalvision.sweep import PanoramaSweep
from sphericalvision.sweep.depth_hint import DepthHint
from tests.laws.cameras import uneven_rig
from tests.sweep.textured_sphere import sphere_at  # noqa: F401 (for the table)
from tests.values import numbers_in, rand, sum_of

RIG, IMAGES = uneven_rig(), 2 * rand(2, 3, 3, 642) - 1
SEEN = rand(2, 3, 642, seed=3) > 0.1
OFFSETS = (RIG.center - RIG.positions).expand(2, 3, 3)
MAPS = rand(2, 3, 2, 12, 17, seed=4)
COST, GUIDE = rand(2, 7, 162, seed=5), rand(2, 3, 162, seed=6)


def panorama(every: int, stride: int = 3) -> Any:
    sweep = PanoramaSweep((6, 12), 8, 0.4, stride, every)
    tables = sweep.tables(RIG)
    one = tables.at_spheres((2 * rand(2, 6, 12, seed=7)).long()).every_second_pixel()
    seen = sweep.seen(tables, rand(2, 3, 36, 50, seed=8) > 0.4)
    return sweep(MAPS, tables), seen, sweep.camera_values(MAPS[:, 1], one, 1), one.seen


def hint_of_few() -> DepthHint:
    weight = rand(2, 162, seed=9)
    return DepthHint(rand(2, 162, seed=10), weight * (weight > 0.6)).coarser()


MODULES = "sweep.appearance sweep.appearance_at_depth sweep.nearest_depth sweep.ring_mean "
MODULES += "sweep.semi_global sweep.winner"
"""Where names of the table come from, besides those that are public."""

NUMBERS = """
semi_global_sweep(IMAGES, RIG, 9, 0.4, seen=SEEN) -> -1.56185
semi_global_sweep(IMAGES, RIG, 5, 0.4, 2, 2, 3, 0.1, 1.1, 0.2) -> -5.13020
semi_global_costs(IMAGES, semi_global_tables(RIG, 6, 0.4, 3).sweep, SEEN) -> 6.57330
photo_consistency_share(8 * rand(2, 162, seed=11), IMAGES, RIG, 9, 0.4, SEEN) -> -0.05534
photo_consistency(IMAGES, RIG, 9, 0.4) -> 6.49924
photo_consistency(IMAGES, RIG, 9, 0.4, 2, SEEN) -> 4.46984
semi_global_smoothing(COST, 0.1, 0.8, GUIDE) -> 2.09704
winner_takes_all(COST) -> -19.60248
local_appearance(IMAGES) -> -7.62691
appearance_at_depth(IMAGES, SEEN, OFFSETS, 2 * rand(2, 4, 162, seed=12)) -> 5.87333
appearance_around(IMAGES, SEEN, OFFSETS, 2 * rand(2, 4, 162, seed=12), COST[:, 0] > 0.5) -> -7.83627
coarser_images(IMAGES, SEEN) -> 0.14167
hint_of_few() -> 2.43986
panorama(every=2) -> -1.73211
panorama(every=3) -> 3.30193
nearest_depth(sphere_at(4.0, ring_rig(4), 4), ring_rig(4)) -> 0.35635
"""
"""A call -> the sum over the numbers in its result, each weighted by where it stands."""


@pytest.mark.parametrize(("call", "expected"), numbers_in(NUMBERS))
def test_numbers_stay(call: str, expected: float) -> None:
    assert sum_of(call, globals(), MODULES) == pytest.approx(expected, abs=1e-4)
