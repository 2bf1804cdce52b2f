# SPDX-License-Identifier: Apache-2.0
"""OmniMVS: its size, its pixel centres, and laws that need no reference."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.models import (
    OmniMVS,
)
from sphericalvision.models.omnimvs_parts import (
    CostHourglass,
    FisheyeFeatures,
    SphereConv,
    VolumeConv,
    VolumeUpConv,
    norm_layer,
)
from sphericalvision.sphere import Equirectangular
from sphericalvision.sweep import inverse_depth_from_index
from sphericalvision.sweep.panorama_sweep import PanoramaTables
from tests.laws.grid_laws import UP, rotation_about

SIZE = (24, 30)


def small_net(**changes: Any) -> OmniMVS:
    torch.manual_seed(0)
    settings = {
        "num_hypotheses": 8,
        "feature_channels": 2,
        "num_cameras": 3,
        "output_size": (8, 16),
        "in_channels": 3,
        "num_scales": 2,
    }
    return OmniMVS(**(settings | changes))


def small_rig(num_cameras: int = 3) -> CameraRig:
    return ring_rig(num_cameras, image_size=SIZE)


def images(generator: torch.Generator, batch: int = 2, num_cameras: int = 3) -> Tensor:
    return 2 * torch.rand(batch, num_cameras, 3, *SIZE, generator=generator) - 1


def ready(net: OmniMVS, photographs: Tensor, rig: CameraRig) -> tuple[Tensor, PanoramaTables]:
    """What the sweep takes."""
    return net.extract_features(photographs), net.tables(rig)


def test_the_published_size() -> None:
    """10.9 million parameters at 32 channels, as the paper's table of layers has."""
    net = OmniMVS()
    assert sum(parameter.numel() for parameter in net.parameters()) == pytest.approx(10.9e6, abs=0.05e6)
    assert net.grid.shape == (160, 640)
    assert net.grid.max_latitude == math.pi / 4
    convolutions = [m for m in net.features.modules() if isinstance(m, torch.nn.Conv2d)]
    assert [c.dilation[0] for c in convolutions] == [1] * 11 + [2, 2, 3, 3, 4, 4, 1]
    assert net.hourglass.across[-1][0].conv.in_channels == 256


@pytest.mark.parametrize("num_hypotheses", [4, 6, 10, 16])
def test_any_even_number_of_hypotheses(generator: torch.Generator, num_hypotheses: int) -> None:
    net = small_net(num_hypotheses=num_hypotheses)
    scores = net.hourglass(net.aggregation(net.sweep_features(*ready(net, images(generator), small_rig()))))
    assert scores.shape == (2, num_hypotheses, 8, 16)


def centre_of_mass(values: Tensor) -> Tensor:
    """Mean position of absolute values along each dimension."""
    values = values.detach().abs()
    return torch.stack(
        [
            (values.sum([d for d in range(values.ndim) if d != dim]) * torch.arange(size)).sum()
            / values.sum()
            for dim, size in enumerate(values.shape)
        ]
    )


def with_equal_taps(module: torch.nn.Module) -> torch.nn.Module:
    """Give all convolutions equal positive taps, so that responses are symmetric about their centres."""
    with torch.no_grad():
        for part in module.modules():
            if isinstance(part, torch.nn.modules.conv._ConvNd):
                part.weight.fill_(1 / part.weight[0].numel())
    return module.eval()


def test_a_feature_pixel_stands_for_the_image_pixel_of_twice_its_number() -> None:
    """A ramp comes out of the features as the ramp at every second pixel: no half pixel is lost on the way."""
    features = with_equal_taps(FisheyeFeatures(1))
    image = torch.ones(1, 1, 161, 161, requires_grad=True)
    (gradient,) = torch.autograd.grad(features(image)[0, 0, 40, 38], image)
    torch.testing.assert_close(centre_of_mass(gradient[0, 0]), torch.tensor([80.0, 76.0]), rtol=0, atol=1e-3)
    ramp = torch.arange(161.0).expand(1, 1, 161, 161) + 10
    slope = features(ramp)[0, 0, 40, 37:44].diff()
    torch.testing.assert_close(slope, slope[:1].expand(6), rtol=1e-4, atol=0)
    entry = features.entry[0]  # type: ignore[index, union-attr]
    entry.bias = None  # type: ignore[union-attr]
    filtered = entry(ramp)[0, 0, 40, 2:-2]  # type: ignore[operator]
    torch.testing.assert_close(filtered, ramp[0, 0, 80, 4:-4:2])


@pytest.mark.parametrize("circular", [False, True])
def test_volumes_keep_every_second_voxel_as_centre(circular: bool) -> None:
    spheres = torch.zeros(1, 1, 1, 16, 32, requires_grad=True)
    taps = with_equal_taps(SphereConv(1, 1, circular))
    (gradient,) = torch.autograd.grad(taps(spheres)[0, 0, 0, 4, 6], spheres)
    torch.testing.assert_close(centre_of_mass(gradient[0, 0]), torch.tensor([0.0, 8.0, 12.0]))
    volume = torch.ones(1, 1, 8, 16, 32, requires_grad=True)
    down = with_equal_taps(VolumeConv(1, 1, 2, circular=circular))
    (gradient,) = torch.autograd.grad(down(volume)[0, 0, 2, 4, 6], volume)
    torch.testing.assert_close(centre_of_mass(gradient[0, 0]), torch.tensor([4.0, 8.0, 12.0]))
    up = with_equal_taps(VolumeUpConv(1, 1, None, circular))
    point = torch.zeros(1, 1, 4, 8, 16)
    point[0, 0, 2, 4, 6] = 1
    spread = up(point, (8, 16, 32)) - up(torch.zeros_like(point), (8, 16, 32))
    torch.testing.assert_close(centre_of_mass(spread[0, 0]), torch.tensor([4.0, 8.0, 12.0]))


def turned(rig: CameraRig, columns: int, width: int) -> CameraRig:
    return rig.rotated(rotation=rotation_about(-UP, 2 * math.pi * columns / width).float())


@pytest.mark.parametrize("aggregation", ["concatenation", "variance"])
@torch.no_grad()
def test_with_circular_padding_a_turned_rig_turns_the_panorama(
    generator: torch.Generator, aggregation: str
) -> None:
    """By every 8 columns, which the encoder's coarsest scale steps by; the zeros of the paper's padding show."""
    photographs = images(generator, 1)
    changes = []
    for circular in (True, False):
        net = small_net(circular=circular, output_size=(8, 32), norm="instance", aggregation=aggregation)
        net = net.double().eval()
        rig = small_rig().to(dtype=torch.float64)
        logits, after = (
            net.hourglass(net.aggregation(net.sweep_features(*ready(net, photographs.double(), each))))
            for each in (rig, turned(rig, 8, 32))
        )
        changes.append((after - logits.roll(8, -1)).abs().max())
    assert changes[0] < 1e-4 < changes[1]


@torch.no_grad()
def test_grey_is_the_luminance_of_colour(generator: torch.Generator) -> None:
    net = small_net(in_channels=1).eval()
    colour = images(generator)
    grey = (0.299 * colour[:, :, :1] + 0.587 * colour[:, :, 1:2] + 0.114 * colour[:, :, 2:]).contiguous()
    torch.testing.assert_close(net(colour, small_rig()), net(grey, small_rig()), rtol=0, atol=1e-4)


@torch.no_grad()
def test_seen_is_by_two_cameras_at_the_estimated_index(generator: torch.Generator) -> None:
    net, rig = small_net(aggregation="variance").eval(), small_rig()
    index, _, seen = net.predict(images(generator), rig)
    for pixel in torch.randint(8 * 16, (40,), generator=generator).tolist():
        row, column = divmod(pixel, 16)
        nearest = 2 * (index[0, row, column] / 2).round().clamp(max=3)
        inverse_depth = inverse_depth_from_index(nearest, 8, 0.55)
        cameras = rig.points_seen(net.grid.directions[row, column][None], inverse_depth[None])
        assert seen[0, row, column] == (cameras.sum() >= 2)


def test_index_at_other_directions(generator: torch.Generator) -> None:
    net = small_net(output_size=(8, 32))
    directions = Equirectangular(16, 32).directions
    index = torch.rand(2, 8, 32, generator=generator)
    values, inside = net.index_at(index, directions.flatten(0, 1))
    assert torch.equal(inside.view(16, 32).all(1), (torch.arange(16) >= 4) & (torch.arange(16) < 12))
    torch.testing.assert_close(values[:, inside].view(2, 8, 32), index, rtol=0, atol=1e-4)


def test_each_channel_of_each_sample_is_normalised_alone(generator: torch.Generator) -> None:
    values = torch.randn(2, 3, 5, 7, generator=generator) + torch.arange(6.0).view(2, 3, 1, 1)
    expected = torch.nn.functional.instance_norm(values)
    torch.testing.assert_close(norm_layer("instance", 3, 2)(values), expected, rtol=0, atol=1e-5)


def test_the_hourglass_doubles_the_volume() -> None:
    hourglass = CostHourglass(4, 2, 3, "instance")
    assert hourglass(torch.randn(2, 4, 5, 9, 16)).shape == (2, 10, 18, 32)
