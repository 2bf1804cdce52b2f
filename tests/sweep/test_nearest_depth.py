# SPDX-License-Identifier: Apache-2.0
"""The nearest hypothesis, found from the images."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.core import ArgumentError
from sphericalvision.data import ToSphere
from sphericalvision.icosphere import Icosphere
from sphericalvision.scenes import make_scene, ray_depth, render_rig
from sphericalvision.sweep.hypotheses import index_from_depth
from sphericalvision.sweep.nearest_depth import nearest_depth


@pytest.mark.parametrize(("kind", "radius", "seed"), [("room", 0.2, 4), ("hall", 0.06, 2)])
def test_found_depth_is_before_nearly_everything_and_not_far_before(kind, radius, seed):
    rig = ring_rig(4, radius, image_size=(128, 128))
    scene = make_scene(kind, seed)
    images = ToSphere(5).images(render_rig(scene, rig, 2), rig)[None]
    found = nearest_depth(images, rig)
    depth = ray_depth(scene, rig.center, Icosphere(5).vertices)
    assert found < depth.quantile(0.02)
    assert found > 0.4 * depth.quantile(0.005)


@pytest.mark.parametrize(
    ("false", "surface", "nearest"),
    [(0.01, 4.0, 2.6), (0.03, 4.0, 0.65), (0.01, 0.09, 0.06), (0.01, 0.1, 0.065)],
)
def test_of_what_is_only_seen_four_times_as_much_may_be_nearer(
    false: float, surface: float, nearest: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between one and four times the quantile of false matches do not count, more do: the floor, though never sure.

    What is as near as the cameras themselves is not looked for.
    """
    depths, calls = torch.full((1, 1000), surface), []
    depths[:, : int(1000 * false)] = 1.0
    sure = depths > 100
    sure[:, -1] = True

    def sweep(images: object, rig: object, number: int, nearest: float, **_: object) -> tuple[Tensor, ...]:
        calls.append((number, nearest))
        return index_from_depth(depths, number, nearest), 0.59 + 0.02 * sure, torch.ones_like(sure)

    monkeypatch.setattr("sphericalvision.sweep.nearest_depth.semi_global_sweep", sweep)
    found = nearest_depth(torch.zeros(1, 4, 3, 642), ring_rig(4, 0.05, (16, 16)))
    assert found == pytest.approx(nearest, rel=1e-3)
    assert calls[0] == (32, pytest.approx(1.2 * 0.05))


def test_refuses_a_rig_without_size():
    rig = ring_rig(2, image_size=(16, 16))
    poses = rig.world_from_camera.clone()
    poses[:, :3, 3] = 0
    images = Icosphere(3).vertices.T.expand(1, 2, 3, -1)
    with pytest.raises(ArgumentError, match="one"):
        nearest_depth(images, CameraRig(rig.cameras, poses))
