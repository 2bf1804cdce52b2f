# SPDX-License-Identifier: Apache-2.0
"""Orientations from brightness: what is found of turns that were put in, and what is refused."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.capture import align_rig_direct
from sphericalvision.capture.calibrating import direct_alignment
from sphericalvision.geometry import transform_from_axis_angle
from sphericalvision.icosphere import icosphere_vertices
from sphericalvision.scenes import make_scene, ray_depth, render_rig

DIRECTIONS = icosphere_vertices(5)


@pytest.fixture(scope="module")
def rig() -> CameraRig:
    return ring_rig(4, image_size=(160, 160))


def frame(rig: CameraRig, kind: str, seed: int) -> tuple[dict[str, Tensor], Tensor]:
    """Images and true inverse depth."""
    scene = make_scene(kind, seed)
    return render_rig(scene, rig, 2), ray_depth(scene, rig.center, DIRECTIONS).reciprocal()


@pytest.fixture(scope="module")
def room(rig: CameraRig) -> tuple[dict[str, Tensor], Tensor]:
    return frame(rig, "room", 5)


def knocked(rig: CameraRig, degrees: float, which: list[int] | None = None) -> CameraRig:
    """Some of the cameras turned about axes of their own; all of them if not said."""
    generator = torch.Generator().manual_seed(3)
    axes = torch.nn.functional.normalize(torch.randn(len(rig), 3, generator=generator), dim=-1)
    size = torch.zeros(len(rig), 1)
    size[which if which is not None else slice(None)] = math.radians(degrees)
    turns = transform_from_axis_angle(axes * size, torch.zeros(len(rig), 3))
    poses = rig.world_from_camera.clone()
    poses[:, :3, :3] = turns[:, :3, :3] @ poses[:, :3, :3]
    return CameraRig(rig.cameras, poses, rig.masks)


def apart(one: CameraRig, other: CameraRig) -> float:
    """Degrees, root mean square over cameras, but for a turn of the whole rig."""
    change = other.world_from_camera[:, :3, :3] @ one.world_from_camera[:, :3, :3].mT
    odd = (change - change.mT) / 2
    turns = torch.stack((odd[:, 2, 1], odd[:, 0, 2], odd[:, 1, 0]), -1)
    return math.degrees(float((turns - turns.mean(0)).square().sum(-1).mean().sqrt()))


@pytest.mark.parametrize("degrees", [0.3, 1.0])
def test_turns_are_found_in_one_frame(
    rig: CameraRig, room: tuple[dict[str, Tensor], Tensor], degrees: float
) -> None:
    wrong = knocked(rig, degrees)
    found = align_rig_direct(wrong, room[0], DIRECTIONS, room[1], iterations=8)
    found = align_rig_direct(found.rig, room[0], DIRECTIONS, room[1], blur=0.6, iterations=4)
    assert apart(rig, wrong) > 0.85 * degrees
    assert apart(rig, found.rig) < 0.15
    assert found.agreement[1] > 0.9


def test_depth_may_be_off(rig: CameraRig, room: tuple[dict[str, Tensor], Tensor]) -> None:
    images, truth = room
    turned = [
        align_rig_direct(knocked(rig, 0.7), images, DIRECTIONS, factor * truth, blur=0.6, iterations=8).rig
        for factor in (1.0, 1.1, 0.9)
    ]
    assert max(apart(turned[0], other) for other in turned[1:]) < 0.1


def test_what_is_nearer_than_the_cameras_can_see_is_as_near_as_they_can(
    rig: CameraRig, room: tuple[dict[str, Tensor], Tensor]
) -> None:
    images, truth = room
    nearest = direct_alignment._NEAREST / float(rig.radius)
    near = torch.arange(len(truth)) % 7 == 0
    limited, beyond = (
        align_rig_direct(rig, images, DIRECTIONS, truth.where(~near, value), iterations=1).turns
        for value in (nearest, 50 * nearest)
    )
    torch.testing.assert_close(limited, beyond, rtol=0, atol=1e-6)


def test_several_frames_are_one_problem(rig: CameraRig) -> None:
    frames = [frame(rig, "room", 5), frame(rig, "floating", 2), frame(rig, "hall", 1)]
    wrong = knocked(rig, 0.7)
    alone = [align_rig_direct(wrong, *(f[0], DIRECTIONS, f[1]), iterations=8).rig for f in frames]
    images = {name: torch.stack([f[0][name] for f in frames]) for name in rig.names}
    together = align_rig_direct(wrong, images, DIRECTIONS, torch.stack([f[1] for f in frames]), iterations=8)
    assert apart(rig, together.rig) < sum(apart(rig, one) for one in alone) / 3
    assert apart(rig, together.rig) < 0.2


def test_exposure_vignetting_and_hidden_parts_do_not_turn_cameras(
    rig: CameraRig, room: tuple[dict[str, Tensor], Tensor]
) -> None:
    images, truth = room
    around = torch.linspace(-1, 1, 160)
    vignetting = 1 - 0.4 * (around[:, None].square() + around.square()).clamp(max=1)
    faulty = {
        name: image * vignetting * (0.6 + 0.1 * place) for place, (name, image) in enumerate(images.items())
    }
    clean, found = (align_rig_direct(rig, each, DIRECTIONS, truth, blur=0.6).rig for each in (images, faulty))
    assert apart(rig, found) < apart(rig, clean) + 0.05


def test_what_masks_hide_has_no_influence(rig: CameraRig, room: tuple[dict[str, Tensor], Tensor]) -> None:
    images, truth = room
    mask = torch.ones(160, 160, dtype=torch.bool)
    mask[100:] = False
    masked = CameraRig(rig.cameras, rig.world_from_camera, {"cam2": mask})
    other = {**images, "cam2": images["cam2"].where(mask, torch.rand(3, 160, 160))}
    one, two = (align_rig_direct(masked, pictures, DIRECTIONS, truth).turns for pictures in (images, other))
    torch.testing.assert_close(one, two, rtol=0, atol=1e-6)


def test_the_camera_that_was_knocked_is_the_one_that_turns(
    rig: CameraRig, room: tuple[dict[str, Tensor], Tensor]
) -> None:
    wrong = knocked(rig, 1.0, [1])
    found = align_rig_direct(wrong, room[0], DIRECTIONS, room[1], iterations=10)
    degrees = found.turns.norm(dim=-1).rad2deg()
    assert degrees[1] > 0.6
    assert degrees[[0, 2, 3]].max() < 0.4


def test_weights_choose_what_counts(rig: CameraRig, room: tuple[dict[str, Tensor], Tensor]) -> None:
    images, truth = room
    lower = (DIRECTIONS[:, 1] > 0).float()
    absurd = truth.where(lower > 0, torch.rand(len(truth)) * 1.5)
    weighted = align_rig_direct(knocked(rig, 0.5), images, DIRECTIONS, absurd, lower, iterations=8)
    right = align_rig_direct(knocked(rig, 0.5), images, DIRECTIONS, truth, lower, iterations=8)
    torch.testing.assert_close(weighted.turns, right.turns, rtol=0, atol=1e-5)
