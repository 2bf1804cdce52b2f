# SPDX-License-Identifier: Apache-2.0
"""The sweep onto panoramas against single points pushed through the cameras, and its laws."""

from __future__ import annotations

import pytest
import torch

from sphericalvision.cameras import CameraRig
from sphericalvision.sweep import PanoramaSweep, inverse_depth_hypotheses
from tests.sweep.test_sphere_sweep import random_rig

DOUBLE = torch.float64
SIZE = (40, 46)


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_maps_of_the_pixels_give_the_pixels_of_the_points(generator: torch.Generator, stride: int) -> None:
    """Maps that hold their own pixels' coordinates in the image: the sweep must find each point's pixel exactly."""
    rig = random_rig(generator, SIZE)
    sweep = PanoramaSweep((6, 12), num_hypotheses=5, min_depth=0.5, stride=stride)
    grid = next(iter(rig.cameras.values())).pixel_grid(DOUBLE).permute(2, 0, 1)
    ramps = grid[:, ::stride, ::stride].expand(1, 3, -1, -1, -1)
    values, tables = sweep(ramps, rig)[0], sweep.tables(rig)
    assert tables.seen.float().mean() > 0.3
    hypotheses = inverse_depth_hypotheses(5, 0.5, DOUBLE)[::2]
    for k, (pose, camera) in enumerate(zip(rig.world_from_camera, rig.cameras.values(), strict=True)):
        points = rig.center + sweep.grid.directions.to(DOUBLE) / hypotheses[:, None, None, None]
        pixels, seen = camera.project((points - pose[:3, 3]) @ pose[:3, :3])
        assert torch.equal(tables.seen[k], seen)
        last = torch.tensor([s - 1 - (s - 1) % stride for s in SIZE[::-1]], dtype=DOUBLE)
        expected = torch.minimum(pixels.clamp(min=0), last) * seen[..., None]
        torch.testing.assert_close(values[k].permute(1, 2, 3, 0), expected, rtol=0, atol=1e-4)


def test_masked_pixels_are_out_of_view(generator: torch.Generator) -> None:
    rig = random_rig(generator, SIZE)
    upper = torch.zeros(SIZE, dtype=torch.bool)
    upper[:20] = True
    masked = CameraRig(rig.cameras, rig.world_from_camera, {"cam2": upper})
    sweep = PanoramaSweep((6, 12), num_hypotheses=4, min_depth=0.5)
    plain, tables = sweep.tables(rig), sweep.tables(masked)
    assert torch.equal(tables.seen[0], plain.seen[0])
    assert 0 < tables.seen[1].sum() < plain.seen[1].sum()
    ones = torch.ones(1, 3, 1, SIZE[0] // 2, SIZE[1] // 2, dtype=DOUBLE)
    torch.testing.assert_close(sweep(ones, tables)[0, :, 0], tables.seen.to(DOUBLE))


def test_gradients_reach_maps_and_poses(generator: torch.Generator) -> None:
    rig = random_rig(generator, SIZE)
    poses = rig.world_from_camera.clone().requires_grad_()
    maps = torch.randn(1, 3, 1, SIZE[0] // 2, SIZE[1] // 2, dtype=DOUBLE, generator=generator)
    maps.requires_grad_()
    sweep = PanoramaSweep((4, 8), num_hypotheses=4, min_depth=0.5)
    sweep(maps, CameraRig(rig.cameras, poses)).square().sum().backward()
    for leaf in (maps, poses):
        assert leaf.grad is not None
        assert leaf.grad.isfinite().all()
        assert leaf.grad.abs().sum() > 0
