# SPDX-License-Identifier: Apache-2.0
"""Rectified pairs with OpenCV's matching as a method of comparisons."""

from __future__ import annotations

import pytest
import torch

from sphericalvision.cameras import ring_rig
from sphericalvision.core import ShapeError
from sphericalvision.recipes.evaluation.methods import make_method
from sphericalvision.recipes.evaluation.rectified_sgbm import RectifiedSGBM
from sphericalvision.scenes import make_scene, ray_depth, render_rig
from sphericalvision.sweep import index_from_inverse_depth


def test_depth_of_a_rendered_room() -> None:
    rig, scene = ring_rig(4, image_size=(128, 128)), make_scene("room", seed=3)
    method = make_method("rectified-sgbm", level=5)
    net = method.net
    assert isinstance(net, RectifiedSGBM)
    images = net.intake(rig)(render_rig(scene, rig, samples_per_pixel=2))
    blank = torch.zeros_like(images)
    estimate = net.predict(torch.stack((images, blank)), net.tables(rig))
    assert estimate.index.shape == (2, 48, 96)
    truth = ray_depth(scene, rig.center, net.grid.directions).reciprocal()
    error = (estimate.index[0] - index_from_inverse_depth(truth, 16, 0.55)).abs()
    assert error.median() < 0.3  # of 15
    assert error[estimate.seen[0]].mean() < 1.5
    assert estimate.seen[0].float().mean() > 0.9
    assert (estimate.confidence[~estimate.seen] == 0).all()
    assert estimate.index.isfinite().all()
    assert (estimate.index >= 0).all()
    assert (estimate.index <= 15).all()


def test_what_is_masked_is_not_matched() -> None:
    rig, scene = ring_rig(4, image_size=(64, 64)), make_scene("room", seed=3)
    net = RectifiedSGBM(level=4)
    images = net.intake(rig)(render_rig(scene, rig, samples_per_pixel=1))
    seen = torch.ones(4, 64, 64, dtype=torch.bool)
    seen[0] = False  # of the camera in front
    partly = net.predict(images[None], rig, seen).seen[0]
    # Between ahead and right none but these two cameras look, between back and right two others do.
    aside, behind = partly[8:16, 29:31], partly[8:16, 41:43]
    assert behind.float().mean() > 0.9
    assert not net.predict(images[None], rig, torch.zeros_like(seen)).seen.any()
    assert aside.float().mean() < 0.2
    with pytest.raises(ShapeError, match="images: expected shape"):
        net.predict(images, rig)
