# SPDX-License-Identifier: Apache-2.0
"""Laws of IcoSweepNet that need no reference."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import ring_rig
from sphericalvision.crown import Crown, from_crown, to_crown
from sphericalvision.crown.fast import cpp
from sphericalvision.kernels import kernels
from sphericalvision.losses import depth_index_huber
from sphericalvision.models import IcoSweepNet
from sphericalvision.models.icosweepnet import CostRegularizer, camera_by_camera
from tests.models.test_one_graph import Operators

LEVEL, IMAGE_VERTICES = 3, 642


def small_net(**changes: Any) -> IcoSweepNet:
    torch.manual_seed(0)
    settings = {"level": LEVEL, "num_hypotheses": 4, "feature_channels": 4, "num_cameras": 3} | changes
    return IcoSweepNet(**settings)


def images(generator: torch.Generator, batch: int = 2, num_cameras: int = 3) -> Tensor:
    return 2 * torch.rand(batch, num_cameras, 3, IMAGE_VERTICES, generator=generator) - 1


def test_cameras_are_shuffled_in_training_unless_told_otherwise() -> None:
    """Laws of the aggregation say how."""
    assert small_net().aggregation.shuffle
    assert not small_net(shuffle_cameras=False).aggregation.shuffle


@torch.no_grad()
def test_training_takes_statistics_one_camera_at_a_time(generator: torch.Generator) -> None:
    """Running values after a step are those of plain passes over the cameras, in order."""
    net, batch = small_net(), images(generator)
    alone = small_net()
    net.train()(batch, ring_rig(3))
    for camera in range(3):
        alone.train().features(batch[:, camera])
    expected = alone.features.state_dict()
    assert expected["entry.norm.num_batches_tracked"] == 3
    for name, value in net.features.state_dict().items():
        torch.testing.assert_close(value, expected[name])


def test_statistics_of_cameras_at_once_are_those_of_one_at_a_time(generator: torch.Generator) -> None:
    """Features, running statistics and gradients, by a quarter of the operators."""
    batch, results, counts = images(generator), [], []
    for way in ("plain", "graph"):
        net = small_net().train()
        with kernels(way), Operators() as counted:
            features = camera_by_camera(net.features, batch)
        (features.square() * torch.arange(features.shape[-1])).mean().backward()
        gradients = [parameter.grad for parameter in net.features.parameters()]
        results.append((features.detach(), net.features.state_dict(), gradients))
        counts.append(counted.launches)
    torch.testing.assert_close(results[1], results[0], rtol=1e-3, atol=1e-4)
    assert counts[1] < counts[0] / 2


@torch.no_grad()
def test_instance_normalisation_knows_neither_batch_nor_mode(generator: torch.Generator) -> None:
    net = small_net(norm="instance", shuffle_cameras=False)
    batch, rig = images(generator), ring_rig(3)
    evaluated = net.eval()(batch, rig)
    assert evaluated.std() > 1e-2
    trained = net.train()(batch, rig)
    torch.testing.assert_close(trained, evaluated, rtol=0, atol=1e-5)
    torch.testing.assert_close(net.eval()(batch[1:], rig), evaluated[1:], rtol=0, atol=1e-5)


@pytest.mark.parametrize("recompute", [False, True])
def test_operators_may_become_ready_in_the_middle_of_a_training_step(
    generator: torch.Generator, monkeypatch: pytest.MonkeyPatch, recompute: bool
) -> None:
    net, batch, rig = small_net(num_cameras=4), images(generator, 1, 4), ring_rig(4)
    net.train().configure(recompute=recompute)
    asked, ready_after = 0, 0

    def ready(way: str, may_load: bool) -> bool:
        nonlocal asked
        asked += 1
        return asked > ready_after and door_to_operators(way, may_load)

    door_to_operators = cpp.operators_ready
    monkeypatch.setattr(cpp, "operators_ready", ready)
    with kernels("auto"):
        for ready_after in (8, 20, 35):
            asked = 0
            net(batch, rig).sum().backward()
            assert asked > ready_after


def test_on_other_devices_training_computes_nothing_twice() -> None:
    net, calls = small_net(num_cameras=4).to("meta").train(), []
    net.features.fine.register_forward_hook(lambda *_: calls.append(1))
    with kernels("require"):
        net(torch.zeros(1, 4, 3, IMAGE_VERTICES, device="meta"), ring_rig(4).to("meta")).sum().backward()
    assert len(calls) == 1  # all cameras at once


def test_recomputing_reaches_every_block_and_can_be_taken_back() -> None:
    net = small_net().configure(recompute=True)
    assert net.recompute
    assert all(part.recompute for part in (net.features, net.regularizer.fusion, *net.regularizer.blocks))
    assert net.with_changes(num_hypotheses=8).recompute
    assert not net.configure(recompute=False).recompute


def test_a_few_steps_fit_one_sample(generator: torch.Generator) -> None:
    net, rig = small_net(shuffle_cameras=False, level=2).train(), ring_rig(3)
    batch = images(generator, batch=1)[..., :162]
    target = 3 * torch.rand(1, 12, generator=generator)
    tables = net.sweep.tables(rig)
    optimizer = torch.optim.Adam(net.parameters(), 1e-2)
    losses = []
    for _ in range(16):
        loss = depth_index_huber(net(batch, tables), target)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.5 * losses[0]


@torch.no_grad()
def test_residuals_on_vertices_equal_residuals_on_crowns(generator: torch.Generator) -> None:
    """The published order is add, then exchange; ours, exchange then add, is the same and half the work."""
    regularizer = CostRegularizer(in_channels=4, channels=2).train()
    volume = torch.randn(1, 4, 5, 42, generator=generator)
    crown = to_crown(regularizer.fusion(volume))
    for block in regularizer.blocks:
        hidden = block.second(block.first(crown))
        crown = to_crown(from_crown(Crown(hidden.col + crown.col, hidden.row + crown.row)))
    expected = from_crown(regularizer.score(regularizer.reduction(crown)))
    torch.testing.assert_close(regularizer(volume), expected.squeeze(1), rtol=0, atol=1e-5)


@pytest.mark.parametrize("aggregation", ["concatenation", "variance"])
@pytest.mark.parametrize("training", [False, True])
def test_mixed_precision_stays_close_to_single_precision(aggregation: str, training: bool) -> None:
    torch.manual_seed(0)
    net = IcoSweepNet(
        3, 4, feature_channels=16, aggregation=aggregation, shuffle_cameras=False, norm="instance"
    ).train(training)
    pictures, rig = 2 * torch.rand(1, 4, 3, IMAGE_VERTICES) - 1, ring_rig(4)
    found = []
    for mixed in (False, True):
        net.zero_grad()
        with torch.autocast("cpu", torch.bfloat16, enabled=mixed):
            index = net(pictures, rig)
        index.float().square().mean().backward()
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=mixed):
            torch.testing.assert_close(net(pictures, rig), index, atol=1e-2, rtol=1e-2)
        gradients = [p.grad.flatten() for p in net.parameters() if p.grad is not None]
        found.append((index.detach().float(), torch.cat(gradients)))
    (single, of_single), (mixed_index, of_mixed) = found
    assert (single - mixed_index).abs().max() < 0.1
    assert torch.cosine_similarity(of_single, of_mixed, 0) > 0.8
