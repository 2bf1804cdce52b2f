# SPDX-License-Identifier: Apache-2.0
"""Networks on aggregations other than the paper's: any cameras in any order, and one of one's own."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import ring_rig
from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.models import IcoSweepNet, OmniMVS, load_weights, save_weights
from sphericalvision.sweep import Aggregation, SweepVolume, register_aggregation
from sphericalvision.sweep.aggregation import AGGREGATIONS, named_aggregation


@torch.no_grad()
def test_a_camera_that_saw_nothing_does_not_count(generator: torch.Generator) -> None:
    """It is left out; features of its blank images would look like disagreement."""
    torch.manual_seed(0)
    net = IcoSweepNet(
        3, 4, feature_channels=4, norm="instance", aggregation="variance", volume_channels=2
    ).eval()
    rig = ring_rig(3, field_of_view=2 * math.pi)
    images = 2 * torch.rand(1, 3, 3, 642, generator=generator) - 1
    seen = torch.ones(1, 3, 642, dtype=torch.bool)
    seen[:, 1] = False
    volumes = []
    net.regularizer.fusion.register_forward_pre_hook(lambda _, inputs: volumes.append(inputs[0]))
    estimate = net.predict(images, rig, seen)
    mean, variance, share = volumes[0].split((4, 4, 1), 1)
    first, last = net.sweep(net.extract_features(images), rig).values[:, [0, 2]].unbind(1)
    torch.testing.assert_close(mean, (first + last) / 2)
    torch.testing.assert_close(variance, (first - last).square() / 4)
    torch.testing.assert_close(share, torch.full_like(share, 2 / 3))
    assert estimate.seen.all()
    seen[:, 2] = False
    assert not net.predict(images, rig, seen).seen.any()


class Strongest(Aggregation):
    """The strongest answer of the cameras that see a point."""

    def __init__(self, channels: int) -> None:
        super().__init__(out_channels=channels)

    def forward(self, volume: SweepVolume) -> Tensor:
        values = volume.values.masked_fill(~volume.seen.unsqueeze(2), -torch.inf).amax(1)
        return values.where(volume.seen.any(1, keepdim=True), 0.0)


@pytest.fixture
def strongest() -> Iterator[str]:
    """An aggregation of one's own, by name."""
    name = "strongest of the tests"  # the guide's example of this class is named "strongest"
    register_aggregation(name, Strongest)
    yield name
    del AGGREGATIONS.things[name]


def test_an_aggregation_of_ones_own(generator: torch.Generator, tmp_path: Path, strongest: str) -> None:
    """Trained, with any cameras in any order, saved and loaded, in both networks, as an object and by name."""
    torch.manual_seed(0)
    net = IcoSweepNet(3, 4, feature_channels=4, norm="instance", aggregation=strongest)
    batch, rig = 2 * torch.rand(1, 3, 3, 642, generator=generator) - 1, ring_rig(3)
    index = net(batch, rig)
    index.square().mean().backward()
    assert all(p.grad is not None and p.grad.any() for p in net.parameters())
    again = load_weights(save_weights(net, tmp_path / "net.safetensors"))
    torch.testing.assert_close(again(batch[:, [2, 0, 1]], rig.permuted([2, 0, 1])), index, rtol=0, atol=1e-5)
    torch.testing.assert_close(again(batch[:, :2], rig.subset([0, 1])).shape, index.shape)

    by_object = IcoSweepNet(3, 4, feature_channels=4, norm="instance", aggregation=Strongest(4))
    by_object.load_state_dict(net.state_dict())
    assert torch.equal(by_object(batch, rig), index)
    by_object.aggregation.out_channels = 8
    with pytest.raises(ShapeError, match="Strongest has out_channels=8"):
        by_object(batch, rig)
    with pytest.raises(ArgumentError, match=r"aggregation: expected plain values.*got Strongest"):
        save_weights(by_object, tmp_path / "object.safetensors")

    panorama = OmniMVS(
        8, feature_channels=2, output_size=(8, 16), in_channels=3, num_scales=2, aggregation=strongest
    )
    pictures = 2 * torch.rand(1, 5, 3, 24, 30, generator=generator) - 1
    assert panorama(pictures, ring_rig(5, image_size=(24, 30))).shape == (1, 8, 16)


def test_a_class_defined_anew_keeps_its_name(strongest: str) -> None:
    """As when a notebook's cell runs again; another class does not get the name."""
    again = type("Strongest", (Strongest,), {"__module__": Strongest.__module__, "__qualname__": "Strongest"})
    register_aggregation(strongest, again)
    assert isinstance(named_aggregation(strongest, 4, 2), again)
    with pytest.raises(ArgumentError, match="Strongest already"):
        register_aggregation(strongest, type("Other", (Strongest,), {}))
