# SPDX-License-Identifier: Apache-2.0
"""The sphere sweep against a plain loop over cameras and hypotheses, and its laws."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.geometry import transform_from_axis_angle
from sphericalvision.icosphere import Icosphere
from sphericalvision.kernels import reference_kernels
from sphericalvision.sweep import SphereSweep, depth_from_index

DOUBLE = torch.float64


def random_rig(generator: torch.Generator, image_size: tuple[int, int] = (64, 64)) -> CameraRig:
    rig = ring_rig(3, field_of_view=3.5, image_size=image_size).to(dtype=DOUBLE)
    wobble = torch.randn(2, 3, 3, dtype=DOUBLE, generator=generator)
    shaken = rig.world_from_camera @ transform_from_axis_angle(0.3 * wobble[0], 0.05 * wobble[1])
    return CameraRig(rig.cameras, shaken)


def swept_by_loops(features: Tensor, rig: CameraRig, sweep: SphereSweep) -> tuple[Tensor, Tensor]:
    """Do the same one camera and one hypothesis at a time, with points in metres."""
    ico, features_ico = Icosphere(sweep.level, DOUBLE), Icosphere(sweep.feature_level, DOUBLE)
    depths = depth_from_index(
        torch.arange(sweep.num_hypotheses, dtype=DOUBLE), sweep.num_hypotheses, sweep.min_depth
    )
    values, masks = [], []
    for camera, (pose, max_angle) in enumerate(zip(rig.world_from_camera, rig.max_angles, strict=True)):
        for depth in depths:
            rays = rig.center + depth * ico.vertices - pose[:3, 3]
            in_camera = rays @ pose[:3, :3]
            mask = torch.atan2(in_camera[:, :2].norm(dim=-1), in_camera[:, 2]) <= max_angle
            values.append(features_ico.sample(features[:, camera], rays) * mask)
            masks.append(mask)
    batch, num_cameras = features.shape[:2]
    shape = (num_cameras, sweep.num_hypotheses)
    stacked = torch.stack(values).unflatten(0, shape).permute(2, 0, 3, 1, 4)
    return stacked, torch.stack(masks).unflatten(0, shape).expand(batch, -1, -1, -1)


@pytest.mark.parametrize("feature_level", [1, 2, 3])
def test_equals_loops_over_cameras_and_hypotheses(generator: torch.Generator, feature_level: int) -> None:
    rig = random_rig(generator)
    sweep = SphereSweep(2, num_hypotheses=5, min_depth=0.4, feature_level=feature_level)
    features = torch.randn(2, 3, 4, 2 + 10 * 4**feature_level, dtype=DOUBLE, generator=generator)
    values, mask = sweep(features, rig)
    expected, expected_mask = swept_by_loops(features, rig, sweep)
    assert torch.equal(mask, expected_mask)
    # Points at "infinity" are 8 388 608 m away
    torch.testing.assert_close(values, expected, rtol=0, atol=1e-6)


def test_convention_depth_is_along_the_ray() -> None:
    """A mark 2 m from the rig's centre, along a ray, is found at the hypothesis of 2 m."""
    rig = ring_rig(4, field_of_view=2 * math.pi).to(dtype=DOUBLE)
    sweep = SphereSweep(3, num_hypotheses=9, min_depth=0.5, feature_level=5)  # index 2 is 2 m
    ico, fine = Icosphere(3, DOUBLE), Icosphere(5, DOUBLE)
    vertex = 200
    point = rig.center + 2.0 * ico.vertices[vertex]
    # Each camera sees a spot in the direction of the point, from its own position.
    toward = torch.nn.functional.normalize(point - rig.positions, dim=-1)
    images = (20 * (torch.einsum("vd,nd->nv", fine.vertices, toward) - 1)).exp()
    values = sweep(images[None, :, None], rig).values[0, :, 0, :, vertex]
    assert values.prod(0).argmax() == 2
    torch.testing.assert_close(values[:, 2], torch.ones(4, dtype=DOUBLE), rtol=0, atol=2e-2)


def test_order_of_cameras(generator: torch.Generator) -> None:
    rig = random_rig(generator)
    sweep = SphereSweep(2, 4, 0.5)
    features = torch.randn(1, 3, 2, 162, dtype=DOUBLE, generator=generator)
    order = torch.tensor([2, 0, 1])
    expected = sweep(features, rig).values[:, order]
    assert torch.equal(sweep(features[:, order], rig.permuted(order)).values, expected)
    assert torch.equal(sweep(features[:, order], sweep.tables(rig).permuted(order)).values, expected)


def test_camera_at_the_point_itself_is_out_of_view() -> None:
    """No direction leads from a camera to a point at its own position."""
    poses = torch.eye(4, dtype=DOUBLE).repeat(2, 1, 1)
    vertex = Icosphere(1, DOUBLE).vertices[7]
    poses[:, :3, 3] = torch.stack((0.5 * vertex, -0.5 * vertex))
    camera = ring_rig(2, field_of_view=2 * math.pi).to(dtype=DOUBLE).cameras["cam1"]
    rig = CameraRig([camera, camera], poses)
    sweep = SphereSweep(1, 2, 0.5)
    sweep.inverse_depths = torch.tensor([1.0, 2.0], dtype=DOUBLE)
    values, mask = sweep(torch.ones(1, 2, 1, 42, dtype=DOUBLE), rig)
    assert not mask[0, 0, 1, 7]
    assert torch.isfinite(values).all()


def test_gradients_of_features_and_poses(generator: torch.Generator) -> None:
    rig = random_rig(generator)
    sweep = SphereSweep(1, 3, 0.5)
    features = torch.randn(1, 3, 1, 42, dtype=DOUBLE, generator=generator, requires_grad=True)
    shift = torch.zeros(3, 3, dtype=DOUBLE, requires_grad=True)

    def swept(features: Tensor, shift: Tensor) -> Tensor:
        offset = torch.nn.functional.pad(shift[..., None], (3, 0, 0, 1))
        values = sweep(features, CameraRig(rig.cameras, rig.world_from_camera + offset)).values
        return values[..., 1:, :]  # at infinity, points are at vertices, where interpolation has kinks

    assert torch.autograd.gradcheck(swept, (features, shift), fast_mode=True)
    expected = swept(features, shift)
    with reference_kernels():
        torch.testing.assert_close(swept(features, shift), expected)
        assert torch.autograd.gradgradcheck(swept, (features, shift), fast_mode=True)


@pytest.mark.parametrize("finer", [0, 1, 2])
def test_seen_is_looked_up_beside_the_values(finer: int, generator: torch.Generator) -> None:
    """More than half of what is looked up was seen, and the point is in view; values know nothing of it."""
    rig, sweep = ring_rig(3), SphereSweep(2, 5, 0.5)
    features = torch.randn(2, 3, 4, 162, generator=generator)
    seen = torch.rand(2, 3, Icosphere(2 + finer).num_vertices, generator=generator) > 0.3
    values, found = sweep(features, rig, seen)
    assert torch.equal(values, sweep(features, rig).values)
    coarse = seen
    for level in range(2 + finer, 2, -1):
        coarse = coarse[..., Icosphere(level).coarse_ids]
    ids, weights, mask = sweep.tables(rig)
    for camera in range(3):
        share = (coarse[:, camera][:, ids[:, :, camera]] * weights[:, :, camera]).sum(-1)
        expected = (share > 0.5) & mask[:, :, camera]
        near = (share - 0.5).abs() < 1e-6  # where rounding decides
        assert torch.equal(found[:, camera] | near, expected | near)
    assert 0.1 < found.float().mean() < sweep(features, rig).seen.float().mean()


def test_what_was_seen_may_be_shared_by_the_batch(generator: torch.Generator) -> None:
    sweep = SphereSweep(2, 5, 0.5)
    rigs = CameraRig.stack([ring_rig(3), ring_rig(3, radius=0.1)])
    features = torch.randn(2, 3, 4, 162, generator=generator)
    seen = torch.rand(3, 162, generator=generator) > 0.3
    for rig in (rigs, ring_rig(3)):
        shared = sweep(features, rig, seen).seen
        assert torch.equal(shared, sweep(features, rig, seen.expand(2, 3, 162)).seen)
        assert torch.equal(sweep(features, rig, torch.ones_like(seen)).seen, sweep(features, rig).seen)
