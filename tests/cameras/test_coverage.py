# SPDX-License-Identifier: Apache-2.0
"""Fields of view, and how many cameras see a direction: against counting by hand and solid angles in closed form."""

from __future__ import annotations

import math

import pytest
import torch

from sphericalvision.cameras import (
    CameraRig,
    FisheyeCamera,
    PinholeCamera,
    coverage,
    field_of_view,
    overlap,
    ring_rig,
)
from sphericalvision.cameras.field_of_view import focal_length_on_axis, visible_angle
from sphericalvision.icosphere import Icosphere
from tests.laws.camera_laws import circle
from tests.laws.cameras import MODELS


def test_counts_are_those_of_the_cameras_that_see_a_point() -> None:
    """Of a batch for each rig; ``test_rig.py`` asks each camera for each point by hand."""
    rigs = CameraRig.stack([ring_rig(3, radius=0.3), ring_rig(3, radius=0.1).rotated(tilt=0.5)])
    directions, depths = Icosphere(2).vertices, [0.4, 2.0, math.inf]
    seen = rigs.points_seen(directions, torch.tensor(depths).reciprocal())
    assert torch.equal(coverage(rigs, directions, depths), seen.sum(-3))
    assert torch.equal(coverage(rigs, directions, torch.tensor([2])), seen[:, :, 1:2].sum(-3))


def test_shares_are_solid_angles() -> None:
    """A cap of half angle a is (1 − cos a) / 2 of the sphere; two caps back to back share their excess over 90°."""
    lens = FisheyeCamera.from_field_of_view((400, 400), math.radians(220))
    poses = torch.eye(4).repeat(2, 1, 1)
    poses[1, 0, 0] = poses[1, 2, 2] = -1.0  # half a turn about y
    sphere = Icosphere(6)
    counts = coverage(CameraRig([lens, lens], poses), sphere.vertices, [math.inf])
    seen, shared, mean = (part.item() for part in overlap(counts, sphere.solid_angles))
    cap = (1 - math.cos(math.radians(110))) / 2
    assert seen == pytest.approx(1.0)
    assert shared == pytest.approx(math.sin(math.radians(20)), abs=0.005)
    assert mean == pytest.approx(2 * cap, abs=0.005)


@pytest.mark.parametrize("name", MODELS)
def test_just_inside_of_the_visible_angle_is_seen_and_just_outside_not(name: str) -> None:
    camera = MODELS[name](1.0).to(torch.float64)
    azimuth = torch.linspace(0, 6, 50, dtype=torch.float64)
    angle = visible_angle(camera, azimuth)
    for step, expected in ((-1e-6, True), (1e-6, False)):
        turned = (angle + step).clamp_max(math.pi)
        seen = camera.project(circle(turned, azimuth)).valid
        assert torch.equal(seen | (turned == math.pi), torch.full_like(seen, expected) | (turned == math.pi))


def test_fields_of_view_of_a_pinhole() -> None:
    camera = PinholeCamera([100.0, 50.0], [99.5, 49.5], (100, 200))
    horizontal, vertical, widest = field_of_view(camera)
    assert horizontal == pytest.approx(math.pi / 2)
    assert vertical == pytest.approx(math.pi / 2)
    assert widest == pytest.approx(2 * math.atan(math.sqrt(2)), abs=0.01)
    assert focal_length_on_axis(camera).tolist() == pytest.approx([100.0, 50.0], rel=1e-7)


def test_baselines_are_distances() -> None:
    baselines = ring_rig(4, radius=0.2).baselines
    side = 0.2 * math.sqrt(2)
    torch.testing.assert_close(baselines[0], torch.tensor([0.0, side, 0.4, side]))
    torch.testing.assert_close(baselines, baselines.T)


def test_resized_rigs_keep_rays_and_shrink_masks() -> None:
    rig = ring_rig(2, image_size=(64, 64))
    mask = torch.ones(64, 64, dtype=torch.bool)
    mask[10, 20] = False
    rig = CameraRig(rig.cameras, rig.world_from_camera, {"cam1": mask})
    half = rig.resized((32, 32))
    assert (~half.masks["cam1"]).nonzero().tolist() == [[5, 10]]
    third = rig.resized({"cam1": (20, 24)})
    assert third.cameras["cam2"].image_size == (64, 64)
    covered = (~third.masks["cam1"]).nonzero().tolist()
    assert covered == [[3, 7]]  # rows 9.6 to 12.8, columns 18.7 to 21.3
