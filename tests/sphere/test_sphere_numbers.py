# SPDX-License-Identifier: Apache-2.0
"""Images brought from grid to grid and merged, and errors on them, where nothing has symmetry: one number each."""

from itertools import pairwise
from typing import Any

import pytest
import torch

from sphericalvision.geometry import transform_from_axis_angle
from sphericalvision.icosphere import Icosphere
from sphericalvision.sphere import (
    Cubemap,
    Equirectangular,
    Healpix,
    TangentImages,
    Views,
    resample,
    resample_mask,
)
from tests.laws.cameras import uneven_rig
from tests.values import numbers_in, rand, sum_of

DOUBLE = torch.float64
RIG = uneven_rig()
TURN = transform_from_axis_angle(torch.tensor([0.2, -0.4, 0.3]), torch.zeros(3))[:3, :3].double()
PLAIN, WIDE = Icosphere(2, DOUBLE), Equirectangular(9, 16, DOUBLE)
BAND = Equirectangular(7, 15, DOUBLE, latitudes=(-0.4, 0.9), longitudes=(-2.0, 2.7))
TILES, RINGS, PATCHES = Cubemap(5, DOUBLE), Healpix(4, dtype=DOUBLE), TangentImages(0, 6, 0.5, dtype=DOUBLE)
PRED, TRUTH, MASK = 0.3 + 9 * rand(2, 162), 9 * rand(2, 162, seed=1) - 0.4, rand(2, 162, seed=2) > 0.3
AROUND, BEHIND, USED = 2 * rand(2, 16, 32), 2 * rand(2, 16, 32, seed=1) - 0.1, rand(2, 16, 32, seed=4) > 0.3


def taken(quantity: int = 1) -> Views:
    """Images of a rig, with something unknown."""
    images = (rand(2, quantity, 36, 50, seed=k) for k in range(3))
    return Views(
        {name: 0.2 + image * (image > 0.05) for name, image in zip(RIG.names, images, strict=True)}, RIG
    )


def brought(mode: str, *grids: Any, rotation: Any = TURN) -> Any:
    """From each grid to the next."""
    for one, other in pairwise(grids):
        shape = getattr(one, "image_size", None) or one.shape
        yield resample(rand(2, *shape, seed=4), one, other, rotation, mode, 0.3)
        yield resample_mask(one, other, rotation, mode, rand(*shape, seed=5) > 0.1)


MODULES = "cameras.remapping.area metrics.spread metrics.sphere"
"""Where names of the table come from, besides those that are public."""

NUMBERS = """
brought("bilinear", PLAIN, WIDE, TILES, RINGS, PATCHES, RIG.cameras["a"], PLAIN) -> -11.6414
brought("nearest", PLAIN, WIDE, TILES, RINGS, PATCHES, RIG.cameras["a"], PLAIN) -> -17.1425
brought("area", PATCHES, RINGS, BAND, PLAIN, TILES, RIG.cameras["a"], WIDE, Icosphere(0, DOUBLE)) -> -25.7045
brought("area", Equirectangular(24, 48, DOUBLE), Cubemap(2, DOUBLE)) -> 0.0333
brought("bilinear", BAND, PLAIN, BAND, rotation=None) -> 1.2208
taken().merge(WIDE, TURN, quantity="range"), taken().merge(PLAIN, quantity="z") -> 57.6779
taken().merge(WIDE, quantity="z", align=False) -> -73.4710
taken().merge(WIDE, quantity="range", center=RIG.center), taken(3).merge(PLAIN, mode="area").values -> 3.6049
cell_groups(torch.tensor([[1.0, 3.0], [5.2, 0.3]]), None), cell_groups(40 * rand(9, 2), (48, 64)) -> -8.4349
[view.merge(WIDE) for view in [views(rand(2, 16, 32))]] -> 2.0532
[image[..., ::5, ::5] for image in views(rand(2, 16, 32), layout="tangent").images] -> -4.1413
views(rand(2, 9, 16), WIDE, 2 * rand(3, 3) - 1, (1.4, 1.1), (7, 9), "area").images -> -0.7354
[(grid.solid_angles, grid.directions) for grid in (WIDE, BAND, TILES, RINGS, PATCHES)] -> 2.8324
RINGS.neighbors, BAND.contains(PLAIN.vertices) -> 272.4841
depth_error(PRED, TRUTH, MASK, rand(162), 7.0), depth_error(20 * PRED, 20 * TRUTH) -> -102.1701
depth_index_error(PRED, TRUTH, 9, MASK, rand(162)) -> -82.3886
stereo_error(PRED, TRUTH, MASK, rand(162)), omnimvs_error(AROUND, BEHIND, mask=USED) -> -45.9594
left_right_error(AROUND, BEHIND, USED) -> 0.3272
evaluation_mask(RIG, PLAIN.vertices, 2 * rand(2, 162), MASK) -> 0.0646
error_of_surest(PRED, TRUTH, [0.2, 0.5, 1.0], MASK) -> -1.9115
seam_mask(PLAIN.vertices, 0.2) -> -0.9486
seam_mask(Icosphere(4, DOUBLE).vertices) -> -1.2836
bootstrap_interval(PRED[0]), bootstrap_interval(PRED[1, :9]) -> -0.1790
angular_error(rand(9, 3), rand(9, 3, seed=1) - 0.5) -> -0.1090
"""
"""A call -> the sum over the numbers in its result, each weighted by where it stands."""


@pytest.mark.parametrize(("call", "expected"), numbers_in(NUMBERS))
def test_numbers_stay(call: str, expected: float) -> None:
    assert sum_of(call, globals(), MODULES) == pytest.approx(expected, abs=2e-3)
