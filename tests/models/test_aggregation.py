# SPDX-License-Identifier: Apache-2.0
"""How the values of several cameras become one volume."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import ring_rig
from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.models import IcoSweepNet
from sphericalvision.models.aggregation import aggregated_channels, concatenate_cameras, mean_and_variance
from sphericalvision.sweep import SweepVolume


def random_volume(generator: torch.Generator, num_cameras: int = 4) -> SweepVolume:
    """Values ``(2, n, 3, 5, 6)``; some points are seen by no camera, some by one."""
    mask = torch.rand(2, num_cameras, 5, 6, generator=generator) > 0.5
    mask[0, :, 0, 0] = False
    mask[0, :, 0, 1] = torch.arange(num_cameras) == 1
    values = torch.randn(2, num_cameras, 3, 5, 6, generator=generator, dtype=torch.float64)
    return SweepVolume(values * mask.unsqueeze(2), mask)


def test_mean_and_variance_are_those_of_the_cameras_that_see(generator: torch.Generator) -> None:
    values, mask = volume = random_volume(generator)
    result = mean_and_variance(volume)
    assert result.shape == (2, aggregated_channels("variance", 3, 4), 5, 6)
    for b, n, v in torch.cartesian_prod(torch.arange(2), torch.arange(5), torch.arange(6)).tolist():
        seen = values[b, mask[b, :, n, v], :, n, v]
        expected = torch.zeros(7, dtype=torch.float64)
        if len(seen):
            expected = torch.cat((seen.mean(0), seen.var(0, correction=0), torch.tensor([len(seen) / 4])))
        torch.testing.assert_close(result[b, :, n, v], expected.double())


def test_concatenation_keeps_every_channel(generator: torch.Generator) -> None:
    volume = random_volume(generator)
    result = concatenate_cameras(volume)
    assert result.shape == (2, aggregated_channels("concatenation", 3, 4), 5, 6)
    assert torch.equal(result.unflatten(1, (4, 3)), volume.values)


def test_gradients_are_right_and_finite_where_nothing_is_seen(generator: torch.Generator) -> None:
    values, mask = random_volume(generator, num_cameras=2)

    def call(values: Tensor) -> Tensor:
        return mean_and_variance(SweepVolume(values, mask))

    assert torch.autograd.gradcheck(call, values.requires_grad_())


@torch.no_grad()
def test_network_on_variance_takes_any_rig_in_any_order(generator: torch.Generator) -> None:
    torch.manual_seed(0)
    net = IcoSweepNet(
        3,
        4,
        feature_channels=4,
        norm="instance",
        aggregation="variance",
        feature_coarsening=1,
        volume_channels=2,
    ).eval()
    for count in (2, 3, 5):
        images = 2 * torch.rand(1, count, 3, 642, generator=generator) - 1
        order = torch.randperm(count, generator=generator).tolist()
        index = net(images, ring_rig(count))
        assert index.shape == (1, 42)
        assert index.std() > 1e-2
        permuted = net(images[:, order], ring_rig(count).permuted(order))
        torch.testing.assert_close(permuted, index, rtol=0, atol=1e-5)
        torch.testing.assert_close(net.train()(images, ring_rig(count)), index, rtol=0, atol=1e-5)
        net.eval()
    with pytest.raises(ShapeError, match="expected 5 cameras, as the images have, got 4"):
        net(images, ring_rig(4))
    with pytest.raises(ShapeError, match=r"\(B, n, 3, 642\)"):
        net(images[..., :-1], ring_rig(5))


@torch.no_grad()
def test_a_blank_camera_does_not_count(generator: torch.Generator) -> None:
    """A camera whose images are 0, as under a mask, is left out; features of 0 would look like disagreement."""
    torch.manual_seed(0)
    net = IcoSweepNet(
        3, 4, feature_channels=4, norm="instance", aggregation="variance", volume_channels=2
    ).eval()
    rig = ring_rig(3, field_of_view=2 * math.pi)
    images = 2 * torch.rand(1, 3, 3, 642, generator=generator) - 1
    images[:, 1] = 0
    volumes = []
    net.regularizer.fusion.register_forward_pre_hook(lambda _, inputs: volumes.append(inputs[0]))
    net(images, rig)
    mean, variance, share = volumes[0].split((4, 4, 1), 1)
    first, last = net.sweep(net.extract_features(images), rig).values[:, [0, 2]].unbind(1)
    torch.testing.assert_close(mean, (first + last) / 2)
    torch.testing.assert_close(variance, (first - last).square() / 4)
    torch.testing.assert_close(share, torch.full_like(share, 2 / 3))


def test_every_parameter_of_the_variant_learns(generator: torch.Generator) -> None:
    torch.manual_seed(0)
    net = IcoSweepNet(
        3, 4, feature_channels=4, aggregation="variance", feature_coarsening=1, volume_channels=2
    )
    images = 2 * torch.rand(1, 3, 3, 642, generator=generator) - 1
    (net.train()(images, ring_rig(3)) - 1.0).square().mean().backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().max() > 0, name


def test_hyperparameters_rebuild_the_variant() -> None:
    net = IcoSweepNet(
        3, 4, feature_channels=4, aggregation="variance", feature_coarsening=1, volume_channels=2
    )
    again = IcoSweepNet(**net.hyperparameters)
    again.load_state_dict(net.state_dict())
    assert again.hyperparameters == net.hyperparameters


def test_errors_name_argument_and_choices() -> None:
    with pytest.raises(ArgumentError, match=r"aggregation.*variance"):
        IcoSweepNet(3, aggregation="median")
    with pytest.raises(ArgumentError, match="coarsening: expected 1 or 2"):
        IcoSweepNet(3, feature_coarsening=3)
    with pytest.raises(ArgumentError, match="volume_channels"):
        IcoSweepNet(3, volume_channels=0)
