# SPDX-License-Identifier: Apache-2.0
"""Muon: orthogonal steps for matrices, AdamW's for the rest, and a state that goes on where it was."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import pytest
import torch
from torch import Tensor, nn

from sphericalvision.core import ArgumentError
from sphericalvision.recipes.training.muon import SIZE, Muon, orthogonalized


def layers(seed: int = 0) -> nn.Sequential:
    torch.manual_seed(seed)
    return nn.Sequential(
        nn.Conv1d(4, 6, 7), nn.Conv1d(6, 6, 1), nn.Conv1d(6, 6, 1), nn.Flatten(), nn.Linear(6, 2)
    )


def learn(net: nn.Module, optimizer: torch.optim.Optimizer, steps: Sequence[int]) -> None:
    for step in steps:
        generator = torch.Generator().manual_seed(step)
        optimizer.zero_grad()
        net(torch.rand(3, 4, 7, generator=generator)).square().sum().backward()
        optimizer.step()


def weights(net: nn.Module) -> list[Tensor]:
    return [value.detach().clone() for value in net.parameters()]


@pytest.mark.parametrize("shape", [(6, 28), (28, 6), (16, 16), (1, 40), (40, 1)])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_singular_vectors_stay_and_singular_values_become_one(shape: tuple[int, int], scale: float) -> None:
    generator = torch.Generator().manual_seed(0)
    rank = min(shape)
    left, _ = torch.linalg.qr(torch.randn(3, shape[0], rank, generator=generator))
    right, _ = torch.linalg.qr(torch.randn(3, shape[1], rank, generator=generator))
    values = torch.logspace(0, -2, rank)  # one direction a hundred times as strong as another
    found = left.mT @ orthogonalized(scale * (left * values) @ right.mT) @ right
    singular = found.diagonal(dim1=-2, dim2=-1)
    assert ((singular > 0.65) & (singular < 1.25)).all()
    assert (found - torch.diag_embed(singular)).abs().max() < 1e-3


def test_no_gradient_is_no_step() -> None:
    net = layers()
    before = weights(net)
    optimizer = Muon(net.parameters(), lr=0.1)
    optimizer.step()
    for parameter in net.parameters():
        parameter.grad = torch.zeros_like(parameter)
    optimizer.step()
    assert all(map(torch.equal, before, weights(net)))


def test_biases_are_adamws() -> None:
    net, other = layers(), layers()
    muon = Muon(net.parameters(), lr=1e-2, betas=(0.8, 0.99), weight_decay=0.1)
    biases = [value for value in other.parameters() if value.ndim == 1]
    adamw = torch.optim.AdamW(biases, 1e-2, (0.8, 0.99), weight_decay=0.1)
    generator = torch.Generator().manual_seed(0)
    for _ in range(3):
        for one, two in zip(net.parameters(), other.parameters(), strict=True):
            one.grad = torch.randn(one.shape, generator=generator)
            two.grad = one.grad.clone()
        muon.step()
        adamw.step()
    for one, two in zip(net.parameters(), other.parameters(), strict=True):
        assert torch.equal(one, two) == (one.ndim == 1)


@pytest.mark.parametrize(("rows", "size"), [(3, SIZE), (20, 2 * SIZE)])
def test_steps_are_along_the_gradient_and_its_mean(rows: int, size: float) -> None:
    """Nesterov's: of the running mean with this gradient, and of the gradient once more; larger where rows are more."""
    torch.manual_seed(0)
    layer, generator = nn.Linear(5, rows, bias=False), torch.Generator().manual_seed(1)
    optimizer = Muon(layer.parameters(), lr=1e-2, momentum=0.8, weight_decay=0.1)
    expected, mean = layer.weight.detach().clone(), torch.zeros(rows, 5)
    for _ in range(3):
        gradient = torch.randn(rows, 5, generator=generator)
        layer.weight.grad = gradient.clone()
        optimizer.step()
        mean = 0.8 * mean + 0.2 * gradient
        step = orthogonalized((0.8 * mean + 0.2 * gradient)[None])[0]
        expected = (1 - 1e-2 * 0.1) * expected - 1e-2 * size * step
    torch.testing.assert_close(layer.weight.detach(), expected)


def test_layers_of_one_shape_do_not_mix() -> None:
    together, alone = layers(), layers()
    learn(together, Muon(together.parameters(), lr=1e-2), range(1))
    one = alone[1]
    optimizer = Muon(one.parameters(), lr=1e-2)
    alone(torch.rand(3, 4, 7, generator=torch.Generator().manual_seed(0))).square().sum().backward()
    optimizer.step()
    torch.testing.assert_close(one.weight, together[1].weight)


def test_weights_in_any_order_of_memory_are_learned() -> None:
    torch.manual_seed(0)
    net = nn.Conv2d(4, 6, 3)
    other = copy.deepcopy(net).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    for network in (net, other):
        optimizer = Muon(network.parameters(), lr=1e-2, weight_decay=0.1)
        network(torch.rand(1, 4, 5, 5, generator=torch.Generator().manual_seed(0))).square().sum().backward()
        optimizer.step()
    torch.testing.assert_close(net.weight, other.weight)


def test_a_state_that_is_loaded_goes_on_where_it_was() -> None:
    net = layers()
    optimizer = Muon(net.parameters(), lr=1e-2)
    learn(net, optimizer, range(3))
    again, state = copy.deepcopy(net), copy.deepcopy(optimizer.state_dict())
    resumed = Muon(again.parameters(), lr=1.0)
    resumed.load_state_dict(state)
    for network, its in ((net, optimizer), (again, resumed)):
        learn(network, its, range(3, 6))
    assert all(map(torch.equal, weights(net), weights(again)))


def test_a_schedule_changes_all_steps() -> None:
    net = layers()
    optimizer = Muon(net.parameters(), lr=1e-2)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda _: 0.0)
    before = weights(net)
    learn(net, optimizer, range(2))
    schedule.step()
    assert all(map(torch.equal, before, weights(net)))


def test_what_is_no_setting_is_refused() -> None:
    with pytest.raises(ArgumentError, match="groups"):
        Muon([{"params": list(layers().parameters())}])  # type: ignore[list-item]
    with pytest.raises(ArgumentError, match=r"momentum: expected 0 or more, and less than 1, got 1\.5"):
        Muon(layers().parameters(), momentum=1.5)
    with pytest.raises(ValueError, match="learning rate"):
        Muon(layers().parameters(), lr=-1.0)
