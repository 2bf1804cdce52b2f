# SPDX-License-Identifier: Apache-2.0
"""Each function of the room, with its defaults, on a rig, masks and values that have no symmetry: one number each."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, FisheyeCamera, ring_rig
from sphericalvision.geometry import transform_from_axis_angle
from sphericalvision.sweep import (
    PanoramaSweep,
    photo_consistency,
    photo_consistency_share,
    semi_global_smoothing,
    semi_global_sweep,
)
from sphericalvision.sweep.appearance import local_appearance
from sphericalvision.sweep.appearance_at_depth import appearance_around, appearance_at_depth
from sphericalvision.sweep.depth_hint import DepthHint
from sphericalvision.sweep.nearest_depth import nearest_depth
from sphericalvision.sweep.ring_mean import coarser_images
from sphericalvision.sweep.semi_global import semi_global_costs, semi_global_tables
from sphericalvision.sweep.winner import winner_takes_all
from tests.sweep.textured_sphere import sphere_at
from tests.values import weighted_sum

DOUBLE = torch.float64
SIZE = (36, 50)


def rand(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)


def uneven_rig() -> CameraRig:
    """Three lenses, one narrower and masked, turned and moved, around a centre off the origin."""
    ring = ring_rig(3, 0.25, SIZE, 3.7).to(dtype=DOUBLE)
    narrow = FisheyeCamera.from_field_of_view(SIZE, 2.9).to(DOUBLE)
    wobble = transform_from_axis_angle(0.4 * rand(3, 3, seed=1) - 0.2, 0.1 * rand(3, 3, seed=2))
    poses = ring.world_from_camera @ wobble
    poses[:, :3, 3] += torch.tensor([0.3, -0.2, 0.5], dtype=DOUBLE)
    mask = torch.ones(SIZE, dtype=torch.bool)
    mask[22:, :17] = False
    return CameraRig({"a": ring.cameras["cam1"], "b": narrow, "c": ring.cameras["cam3"]}, poses, {"b": mask})


RIG, IMAGES = uneven_rig(), 2 * rand(2, 3, 3, 642) - 1
SEEN = rand(2, 3, 642, seed=3) > 0.1
OFFSETS = (RIG.center - RIG.positions).expand(2, 3, 3)
MAPS = rand(2, 3, 2, 12, 17, seed=4)
COST, GUIDE = rand(2, 7, 162, seed=5), rand(2, 3, 162, seed=6)


def panorama(every: int, stride: int = 3) -> tuple[Tensor, ...]:
    sweep = PanoramaSweep((6, 12), 8, 0.4, stride, every)
    tables = sweep.tables(RIG)
    one = tables.at_spheres((2 * rand(2, 6, 12, seed=7)).long()).every_second_pixel()
    seen = sweep.seen(tables, rand(2, 3, *SIZE, seed=8) > 0.4)
    return sweep(MAPS, tables), seen, sweep.camera_values(MAPS[:, 1], one, 1), one.seen


def hint_of_few() -> DepthHint:
    weight = rand(2, 162, seed=9)
    return DepthHint(rand(2, 162, seed=10), weight * (weight > 0.6)).coarser()


CASES: dict[str, tuple[Callable[[], tuple[Tensor, ...]], float]] = {
    "sweep": (lambda: semi_global_sweep(IMAGES, RIG, 9, 0.4, seen=SEEN), -1.56185),
    "sweep, its levels and steps": (
        lambda: semi_global_sweep(IMAGES, RIG, 5, 0.4, 2, 2, 3, 0.1, 1.1, 0.2),
        -5.13020,
    ),
    "costs": (lambda: semi_global_costs(IMAGES, semi_global_tables(RIG, 6, 0.4, 3).sweep, SEEN), 6.57330),
    "share": (
        lambda: (photo_consistency_share(8 * rand(2, 162, seed=11), IMAGES, RIG, 9, 0.4, SEEN),),
        -0.05534,
    ),
    "photo-consistency": (lambda: photo_consistency(IMAGES, RIG, 9, 0.4), 6.49924),
    "photo-consistency of windows": (
        lambda: photo_consistency(IMAGES, RIG, 9, 0.4, 2, 2, True, SEEN),
        -3.80882,
    ),
    "smoothing": (lambda: (semi_global_smoothing(COST, 0.1, 0.8, GUIDE),), 2.09704),
    "winner": (lambda: (winner_takes_all(COST, subhypothesis=True),), -19.60248),
    "appearance": (lambda: (local_appearance(IMAGES),), -7.62691),
    "appearance at depth": (
        lambda: appearance_at_depth(IMAGES, SEEN, OFFSETS, 2 * rand(2, 4, 162, seed=12)),
        5.87333,
    ),
    "appearance around": (
        lambda: (appearance_around(IMAGES, SEEN, OFFSETS, 2 * rand(2, 4, 162, seed=12), COST[:, 0] > 0.5),),
        -7.83627,
    ),
    "coarser images": (lambda: coarser_images(IMAGES, SEEN), 0.14167),
    "coarser hint": (hint_of_few, 2.43986),
    "panorama": (lambda: panorama(every=2), -1.73211),
    "panorama of every third": (lambda: panorama(every=3), 3.30193),
    "nearest": (lambda: (torch.tensor(nearest_depth(sphere_at(4.0, ring_rig(4), 4), ring_rig(4))),), 0.35635),
}
"""What is computed, and its sum, each number weighted by where it stands."""


@pytest.mark.parametrize("name", CASES)
def test_numbers_stay(name: str) -> None:
    compute, expected = CASES[name]
    assert weighted_sum(*compute()) == pytest.approx(expected, abs=1e-4)
