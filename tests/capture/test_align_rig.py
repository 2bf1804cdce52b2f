# SPDX-License-Identifier: Apache-2.0
"""Orientations of a rig from matched rays, and rays matched in images, where the truth is known."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.capture import RayMatcher, RayMatches, align_rig
from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.geometry import transform_from_axis_angle
from sphericalvision.scenes import make_scene, render_rig


def knocked(rig: CameraRig, degrees: Tensor) -> CameraRig:
    """The rig with cameras turned in the world by rotation vectors (n, 3)."""
    turns = torch.deg2rad(degrees).to(rig.world_from_camera)
    rotations = transform_from_axis_angle(turns, torch.zeros_like(turns))[:, :3, :3]
    poses = rig.world_from_camera.clone()
    poses[:, :3, :3] = rotations @ poses[:, :3, :3]
    return CameraRig(rig.cameras, poses)


def random_turns(degrees: float, number: int, seed: int = 0) -> Tensor:
    turns = torch.randn(number, 3, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.normalize(turns, dim=-1) * degrees


def matches_of(rig: CameraRig, noise_deg: float = 0.0, wrong: float = 0.0) -> RayMatches:
    """Rays of all cameras to 150 points, some noisy, some to another point."""
    generator = torch.Generator().manual_seed(3)
    points = torch.randn(150, 3, generator=generator) * 2
    points = points[points.norm(dim=-1) > 0.6]
    local = (points - rig.positions[:, None]) @ rig.world_from_camera[:, :3, :3]
    rays = torch.nn.functional.normalize(local, dim=-1)
    pairs = torch.combinations(torch.arange(len(rig))).repeat_interleave(len(points), 0)
    first, second = pairs.T
    which = torch.arange(len(points)).repeat(len(pairs) // len(points))
    mistaken = torch.rand(len(which), generator=generator) < wrong
    other = torch.where(mistaken, torch.randint(len(points), which.shape, generator=generator), which)
    second_rays = rays[second, other]
    second_rays = second_rays + math.radians(noise_deg) * torch.randn(second_rays.shape, generator=generator)
    return RayMatches(first, second, rays[first, which], torch.nn.functional.normalize(second_rays, dim=-1))


def relative_errors_deg(found: CameraRig, truth: CameraRig) -> Tensor:
    """By how much each camera is turned against the first, in degrees."""
    off = found.world_from_camera[:, :3, :3] @ truth.world_from_camera[:, :3, :3].mT
    relative = off[0].mT @ off
    cosine = (relative.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    return torch.rad2deg(cosine.double().clamp(max=1).acos())


@pytest.mark.parametrize("number", [2, 3, 6])
def test_cameras_are_turned_back(number: int) -> None:
    truth = ring_rig(number, radius=0.2).to(torch.float64)
    found = align_rig(knocked(truth, random_turns(1.0, number)), matches_of(truth))
    # What the mean of the turns is, rays hardly tell; taking it for zero costs a twentieth of a degree here.
    assert relative_errors_deg(found.rig, truth).max() < 0.07
    assert found.inliers.float().mean() > 0.9
    torch.testing.assert_close(found.rig.positions, truth.positions)


def test_noise_and_wrong_pairs_do_little() -> None:
    truth = ring_rig(4, radius=0.2).to(torch.float64)
    start = knocked(truth, random_turns(1.5, 4))
    found = align_rig(start, matches_of(truth, noise_deg=0.1, wrong=0.4))
    errors = relative_errors_deg(found.rig, truth)
    assert errors.max() < 0.06
    assert 0.4 < found.inliers.float().mean() < 0.75
    # What it says about itself is right to a factor of three.
    spread = torch.rad2deg(found.spread)
    assert spread.min() > errors.max() / 6
    assert spread.max() < 0.1


def test_one_knocked_camera_leaves_the_others_where_they_are() -> None:
    truth = ring_rig(4, radius=0.2).to(torch.float64)
    turns = torch.zeros(4, 3)
    turns[2] = torch.tensor([0.5, -0.7, 0.3])
    found = align_rig(knocked(truth, turns), matches_of(truth, noise_deg=0.05))
    moved = torch.rad2deg(found.turns.norm(dim=-1))
    assert moved[[0, 1, 3]].max() < 0.05
    assert abs(float(moved[2] - turns[2].norm())) < 0.05


def test_a_right_rig_stays() -> None:
    rig = ring_rig(3, radius=0.1)
    found = align_rig(rig, matches_of(rig))
    assert torch.rad2deg(found.turns.norm(dim=-1)).max() < 5e-3
    assert found.rig.world_from_camera.dtype == torch.float32


def test_too_little_is_told() -> None:
    rig = ring_rig(3)
    few = RayMatches(*(part[:15] for part in matches_of(rig)))
    with pytest.raises(ArgumentError, match=r"camera cam1 has \d+ that agree, of 15, and 20 are needed"):
        align_rig(rig, few)
    together = CameraRig(rig.cameras, rig.world_from_camera.clone())
    together.world_from_camera[:, :3, 3] = 0
    with pytest.raises(ArgumentError, match="has 0 that agree"):
        align_rig(together, matches_of(rig))


def test_matches_must_fit() -> None:
    rig = ring_rig(3)
    matches = matches_of(rig)
    with pytest.raises(ShapeError, match="first_rays: expected shape"):
        align_rig(rig, matches._replace(first_rays=matches.first_rays[:, :2]))
    with pytest.raises(ArgumentError, match=r"second: expected .* places of cameras, 0 to 1"):
        align_rig(rig.subset([0, 1]), matches)


def test_rays_are_matched_in_images() -> None:
    """A degree goes to a quarter of that, from one small rendered frame with many things in it."""
    rig = ring_rig(3, radius=0.2, image_size=(128, 128))
    truth = knocked(rig, random_turns(1.0, 3))
    matches = RayMatcher(rig)(render_rig(make_scene("floating", seed=5), truth))
    before = relative_errors_deg(rig, truth).max()
    after = relative_errors_deg(align_rig(rig, matches).rig, truth).max()
    assert after < 0.25 * before
    with pytest.raises(ArgumentError, match="none of cam3"):
        RayMatcher(rig)({"cam1": torch.zeros(3, 128, 128), "cam2": torch.zeros(3, 128, 128)})
