# SPDX-License-Identifier: Apache-2.0
"""How the values of several cameras become one volume."""

from __future__ import annotations

import pytest
import torch

from sphericalvision.sweep import (
    Concatenation,
    MeanVariance,
    SweepVolume,
)
from sphericalvision.sweep.aggregation import named_aggregation


def random_volume(generator: torch.Generator, num_cameras: int = 4) -> SweepVolume:
    """Values ``(2, n, 3, 5, 6)``; some points are seen by no camera, some by one."""
    seen = torch.rand(2, num_cameras, 5, 6, generator=generator) > 0.5
    seen[0, :, 0, 0] = False
    seen[0, :, 0, 1] = torch.arange(num_cameras) == 1
    values = torch.randn(2, num_cameras, 3, 5, 6, generator=generator, dtype=torch.float64)
    return SweepVolume(values * seen.unsqueeze(2), seen)


def test_mean_and_variance_are_those_of_the_cameras_that_see(generator: torch.Generator) -> None:
    values, seen = volume = random_volume(generator)
    result = MeanVariance(channels=3)(volume)
    assert result.shape == (2, MeanVariance(channels=3).out_channels, 5, 6)
    for b, n, v in torch.cartesian_prod(torch.arange(2), torch.arange(5), torch.arange(6)).tolist():
        these = values[b, seen[b, :, n, v], :, n, v]
        expected = torch.zeros(7, dtype=torch.float64)
        if len(these):
            expected = torch.cat((these.mean(0), these.var(0, correction=0), torch.tensor([len(these) / 4])))
        torch.testing.assert_close(result[b, :, n, v], expected.double())


def test_concatenation_keeps_every_channel(generator: torch.Generator) -> None:
    volume = random_volume(generator)
    aggregation = Concatenation(channels=3, num_cameras=4)
    result = aggregation.eval()(volume)
    assert result.shape == (2, aggregation.out_channels, 5, 6)
    assert torch.equal(result.unflatten(1, (4, 3)), volume.values)


def test_concatenation_shuffles_whole_cameras_in_training_alone(generator: torch.Generator) -> None:
    volume = random_volume(generator)
    aggregation, orders = Concatenation(3, 4).train(), set()
    for seed in range(20):
        torch.manual_seed(seed)
        cameras = aggregation(volume).unflatten(1, (4, 3)).unbind(1)
        orders.add(tuple(next(k for k in range(4) if torch.equal(c, volume.values[:, k])) for c in cameras))
        torch.manual_seed(seed)
        assert torch.equal(aggregation(volume), torch.stack(cameras, 1).flatten(1, 2))
    assert len(orders) > 8
    assert all(sorted(order) == [0, 1, 2, 3] for order in orders)
    for still in (Concatenation(3, 4, shuffle=False), named_aggregation("concatenation", 3, 4)):
        assert torch.equal(still.train()(volume), aggregation.eval()(volume))
    assert repr(named_aggregation("concatenation", 3, 4, shuffle=True)) == repr(aggregation)


@pytest.mark.parametrize("name", ["concatenation", "variance"])
def test_aggregations_by_name(generator: torch.Generator, name: str) -> None:
    aggregation = named_aggregation(name, channels=3, num_cameras=4, shuffle=True)
    result = aggregation.train()(random_volume(generator))
    assert result.shape == (2, aggregation.out_channels, 5, 6)
    assert named_aggregation(aggregation, 3, 4) is aggregation
