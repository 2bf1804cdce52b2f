# SPDX-License-Identifier: Apache-2.0
"""What networks compute and learn from, with weights and values that have no symmetry: one number each."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from sphericalvision.losses.depth_loss import depth_index_huber
from sphericalvision.models import ConstantDepth, RefinedSweepNet
from sphericalvision.sweep.depth_hint import DepthHint
from tests.laws.cameras import uneven_rig
from tests.values import numbers_in, rand, sum_of

RIG = uneven_rig().to(torch.float32)
IMAGES, SEEN = (2 * rand(2, 3, 3, 642, seed=1) - 1).float(), rand(2, 3, 642, seed=2) > 0.2
PICTURES = (2 * rand(1, 3, 1, 36, 50, seed=3) - 1).float()
HINT = DepthHint(rand(2, 642, seed=8).float(), (rand(2, 642, seed=9) * (rand(2, 642) > 0.7)).float())


def weighted(net: nn.Module) -> Any:
    """With weights and statistics that depend on where they stand alone."""
    for k, (name, values) in enumerate(net.state_dict().items()):
        if values.is_floating_point():
            noise = rand(*values.shape, seed=k).to(values)
            near_one = "var" in name or (values.ndim == 1 and "weight" in name)
            values.copy_(
                noise + 0.5 if near_one else (3 * noise - 1.5) / math.sqrt(max(1, values[:1].numel()))
            )
    return net.eval()


@torch.no_grad()
def predicted(net: Any, images: Tensor = IMAGES, seen: Tensor | None = SEEN, **more: Any) -> Any:
    return weighted(net).predict(images, RIG, seen, **more)


@torch.no_grad()
def loss_of(net: Any) -> Any:
    target = rand(2, net.grid.num_vertices, seed=5).float() * (net.num_hypotheses - 1)
    valid = rand(*target.shape, seed=6) > 0.2
    return weighted(net).train().training_loss(IMAGES, RIG, SEEN, target, valid, depth_index_huber)


@torch.no_grad()
def classified(net: Any, channels: int = 3) -> Any:
    return weighted(net)(rand(2, channels, *net.grid.shape, seed=7).float())


def refined(**options: Any) -> RefinedSweepNet:
    return RefinedSweepNet(3, 8, inner_hypotheses=6, widths=(4, 6, 8), blocks=(1, 1, 1), **options)


def constant() -> ConstantDepth:
    net = ConstantDepth(3, 8)
    net.fit(rand(5, 42), rand(5, 42, seed=1) > 0.3)
    return net


MODULES = "losses.depth_loss"
"""Where names of the table come from, besides those that are public."""

NUMBERS = """
predicted(IcoSweepNet(3, 6, feature_channels=4, num_cameras=3)) -> -1.5948
predicted(IcoSweepNet(3, 6, 0.4, 4, 3, norm="instance", aggregation="variance", feature_coarsening=1)) -> -0.7811
loss_of(IcoSweepNet(3, 6, feature_channels=4, num_cameras=3, shuffle_cameras=False)) -> 0.3517
predicted(refined()), predicted(refined(), hint=HINT) -> -3.5320
predicted(refined(details=True)) -> -3.7850
loss_of(refined()) -> 3.1547
predicted(OmniMVS(8, 0.5, 2, 3, (8, 32), num_scales=2), PICTURES, None) -> -10.4507
predicted(OmniMVS(8, 0.5, 2, 3, (8, 32), norm="instance", circular=True, num_scales=2), PICTURES, None) -> -9.2074
predicted(SemiGlobalSweep(3, 8, 0.4)) -> 3.4664
predicted(WinnerTakesAll(3, 8, 0.4)) -> 9.2123
predicted(constant()), constant().index_at(rand(1, 42).float(), Icosphere(2).vertices) -> 2.9565
classified(SphereClassifier("hex", 3, in_channels=2), 2) -> -1.1300
classified(SphereClassifier("hexgroup", 3), 1), classified(SphereClassifier("crown", 3), 1) -> -2.4750
classified(SphereSegmenter("hex", 3)) -> -1.4478
classified(SphereSegmenter("planar", 3)), classified(SphereSegmenter("crown", 3)) -> 5.1161
classified(SphereSegmenter("sphere", 3)), classified(SphereSegmenter("hexgroup", 3)) -> -4.2469
solid_angle_mean(rand(2, 42), Icosphere(1).solid_angles.double(), rand(2, 42, seed=1) > 0.3) -> 0.0574
depth_index_huber(9 * rand(2, 42), 9 * rand(2, 42, seed=1), rand(2, 42) > 0.3, 0.7, rand(42)) -> 0.9550
"""
"""A call -> the sum over the numbers in its result, each weighted by where it stands."""


@pytest.mark.parametrize(("call", "expected"), numbers_in(NUMBERS))
def test_numbers_stay(call: str, expected: float) -> None:
    assert sum_of(call, globals(), MODULES) == pytest.approx(expected, abs=2e-3)
