# SPDX-License-Identifier: Apache-2.0
"""The nearest hypothesis, found from the images."""

from __future__ import annotations

import pytest

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.core import ArgumentError
from sphericalvision.data import ToSphere
from sphericalvision.icosphere import Icosphere
from sphericalvision.scenes import make_scene, ray_depth, render_rig
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


def test_refuses_a_rig_without_size_and_wrong_shares():
    rig = ring_rig(2, image_size=(16, 16))
    poses = rig.world_from_camera.clone()
    poses[:, :3, 3] = 0
    images = Icosphere(3).vertices.T.expand(1, 2, 3, -1)
    with pytest.raises(ArgumentError, match="one"):
        nearest_depth(images, CameraRig(rig.cameras, poses))
    with pytest.raises(ArgumentError, match="margin"):
        nearest_depth(images, rig, margin=1.5)
