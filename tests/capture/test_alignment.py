# SPDX-License-Identifier: Apache-2.0
"""``Predictor.align``: cameras that were knocked are turned back, others are left alone."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.capture import Predictor
from sphericalvision.models import DepthNetwork, pretrained
from sphericalvision.scenes import make_scene, ray_depth, render_rig
from sphericalvision.scenes.disturbances import CameraDisturbance


@pytest.fixture(scope="module")
def rig() -> CameraRig:
    return ring_rig(4, image_size=(256, 256))


@pytest.fixture(scope="module")
def net() -> DepthNetwork:
    return pretrained("icosweepnet-small")


@pytest.fixture(scope="module")
def images(rig: CameraRig) -> dict[str, Tensor]:
    return render_rig(make_scene("room", seed=5), rig)


def knocked(rig: CameraRig, images: dict[str, Tensor], degrees: float) -> CameraRig:
    fault = CameraDisturbance(pose_error=math.radians(degrees))
    return fault({"images": images, "rig": rig}, torch.Generator().manual_seed(2))["rig"]


def test_knocked_cameras_are_turned_back(
    rig: CameraRig, net: DepthNetwork, images: dict[str, Tensor]
) -> None:
    predictor = Predictor(knocked(rig, images, 1.0), net, min_depth=0.55)
    truth = ray_depth(make_scene("room", seed=5), rig.center, predictor.network.grid.directions).reciprocal()
    before = (predictor(images).inverse_depth - truth).abs().mean()
    found = predictor.align([images])
    assert found is not None
    assert predictor.rig is found.rig
    assert found.agreement[1] > found.agreement[0]
    assert float(found.turns.norm(dim=-1).mean()) > math.radians(0.4)
    after = (predictor(images).inverse_depth - truth).abs().mean()
    right = (Predictor(rig, net, min_depth=0.55)(images).inverse_depth - truth).abs().mean()
    assert before > 1.2 * right
    assert after < right + 0.3 * (before - right)


def test_a_right_calibration_stays(rig: CameraRig, net: DepthNetwork, images: dict[str, Tensor]) -> None:
    predictor = Predictor(rig, net, min_depth=0.55)
    assert predictor.align([images]) is None
    assert predictor.rig.world_from_camera.equal(rig.world_from_camera)


def test_where_images_say_nothing_cameras_stay(rig: CameraRig, net: DepthNetwork) -> None:
    predictor = Predictor(rig, net, min_depth=0.55)
    grey = {name: torch.full((3, 256, 256), 0.5) for name in rig.names}
    assert predictor.align([grey]) is None
    generator = torch.Generator().manual_seed(0)
    noise = {name: torch.rand(3, 256, 256, generator=generator) for name in rig.names}
    assert predictor.align([noise]) is None
    assert predictor.align([]) is None


def test_two_cameras_need_more(net: DepthNetwork, images: dict[str, Tensor], rig: CameraRig) -> None:
    pair = rig.subset(["cam1", "cam2"])
    predictor = Predictor(pair, net, min_depth=0.55)
    assert predictor.align([{name: images[name] for name in pair.names}]) is None
