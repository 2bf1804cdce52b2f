# SPDX-License-Identifier: Apache-2.0
"""A rig that leans is leveled by the floor in its depth."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.cameras.robot_frame import placed, tilt_of
from sphericalvision.capture import Depth, Predictor
from sphericalvision.capture.leveling import floor_up, leveling_turn
from sphericalvision.core import ArgumentError
from sphericalvision.models import SemiGlobalSweep
from sphericalvision.scenes import make_scene, ray_depth, render_rig

RIG = ring_rig(4, radius=0.2, image_size=(96, 96))
UP = torch.tensor([0.0, -1.0, 0.0])
LEANINGS = [(0.0, 0.0), (12.0, 0.0), (25.0, 40.0), (18.0, -130.0)]
"""Degrees, and the direction of it."""


def leaning(tilt: float, heading: float) -> Tensor:
    """``(4, 4)``, from a leaning rig's own frame to the world of the scene."""
    turn = CameraRig({"": RIG.cameras["cam1"]}, torch.eye(4)[None]).rotated(tilt=math.radians(tilt))
    axis = turn.world_from_camera[0]
    angle = math.radians(heading)
    around = torch.eye(4)
    around[0, 0], around[0, 2] = math.cos(angle), math.sin(angle)
    around[2, 0], around[2, 2] = -math.sin(angle), math.cos(angle)
    return around @ axis @ around.mT


def degrees(first: Tensor, second: Tensor) -> float:
    return math.degrees(math.atan2(float(torch.linalg.cross(first, second).norm()), float(first @ second)))


@pytest.mark.parametrize(("tilt", "heading"), LEANINGS)
def test_the_floor_of_a_scene_says_what_is_up(tilt: float, heading: float) -> None:
    """Of true depth with noise of a tenth of a hypothesis and things on the floor."""
    net, turn = SemiGlobalSweep(4, 16, 0.5), leaning(tilt, heading)[:3, :3]
    assert degrees(turn @ UP, UP) == pytest.approx(tilt, abs=0.01)
    noise = torch.randn(net.grid.num_vertices, generator=torch.Generator().manual_seed(0))
    for seed in range(4):
        scene = make_scene("room", seed=10_100_000 + seed)
        inverse = ray_depth(scene, torch.zeros(3), net.grid.directions @ turn.mT).reciprocal()
        ones = torch.ones_like(inverse)
        depth = Depth((inverse * 0.5 * 15 + 0.1 * noise).clamp(0, 15), ones, ones > 0, net, RIG, {})
        up = floor_up(depth)
        assert up is not None
        assert degrees(up, turn.mT @ UP) < 1.5


def test_a_rendered_rig_that_leans_is_level_afterwards() -> None:
    scene = make_scene("room", seed=10_100_001)
    turn = leaning(20.0, 30.0)
    images = render_rig(scene, placed(RIG, turn))
    predictor = Predictor(RIG, SemiGlobalSweep(6, 32, depth_coarsening=1), min_depth=0.5)
    level, sentence = leveling_turn([predictor(images)])
    world_from_level = turn[:3, :3] @ level[:3, :3].mT
    assert degrees(world_from_level @ UP, UP) < 3
    tilt = tilt_of(placed(RIG, level))
    assert tilt is not None
    assert math.degrees(tilt) == pytest.approx(20, abs=3)  # its cameras lean in the world that is level
    assert "leans by" in sentence


def test_without_a_floor_nothing_is_leveled() -> None:
    net = SemiGlobalSweep(5, 8, 0.5)
    ones = torch.ones(net.grid.num_vertices)
    around = Depth(3 * ones, ones, ones > 0, net, RIG, {})  # a ball has none
    unseen = Depth(3 * ones, ones, ones < 0, net, RIG, {})
    for depth in (around, unseen):
        assert floor_up(depth) is None
    with pytest.raises(ArgumentError, match=r"^up: "):
        leveling_turn([around, unseen])
