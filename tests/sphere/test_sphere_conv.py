# SPDX-License-Identifier: Apache-2.0
"""Convolutions in tangent planes against gnomonic taps laid out by hand, in every way that they are computed."""

import math

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from sphericalvision.sphere import Equirectangular, SphereConv2d, equirectangular_pad, sphere_conv2d
from tests.values import random_values


def gnomonic_convolution(
    images: Tensor, weight: Tensor, stride: tuple[int, int] = (1, 1), dilation: tuple[int, int] = (1, 1)
) -> Tensor:
    """Step from every pixel's direction in its tangent plane, east and south, and look where the step leads."""
    height, width = images.shape[-2:]
    grid = Equirectangular(height, width, dtype=torch.float64)
    centers = grid.directions[:: stride[0], :: stride[1]]
    east = F.normalize(torch.stack((centers[..., 2], 0 * centers[..., 0], -centers[..., 0]), -1), dim=-1)
    south = torch.linalg.cross(centers, east)
    south = south * south[..., 1:].sign()[..., :1]  # downwards
    rows, columns = weight.shape[-2:]
    result = 0
    for a in range(rows):
        for b in range(columns):
            right = (b - columns // 2) * dilation[1] * 2 * math.pi / width
            down = (a - rows // 2) * dilation[0] * math.pi / height
            rays = centers + math.tan(right) * east + math.tan(down) / math.cos(right) * south
            seen = grid.sample(images, rays.reshape(-1, 3)).unflatten(-1, tuple(centers.shape[:2]))
            result = result + torch.einsum("oi,bihw->bohw", weight[:, :, a, b], seen)
    return result


@pytest.mark.parametrize(
    ("size", "kernel", "stride", "dilation"),
    [
        ((8, 16), (3, 3), (1, 1), (1, 1)),
        ((9, 18), (3, 5), (1, 1), (1, 1)),
        ((12, 24), (5, 3), (2, 2), (1, 1)),
        ((12, 20), (3, 3), (2, 1), (2, 2)),
        ((7, 13), (1, 3), (1, 2), (1, 2)),
    ],
)
def test_agrees_with_gnomonic_taps(
    size: tuple[int, int], kernel: tuple[int, int], stride: tuple[int, int], dilation: tuple[int, int]
) -> None:
    images, weight, bias = random_values(2, 3, *size), random_values(4, 3, *kernel), random_values(4)
    expected = gnomonic_convolution(images, weight, stride, dilation) + bias[:, None, None]
    result = sphere_conv2d(images, weight, bias, stride, dilation)
    torch.testing.assert_close(result, expected, rtol=0, atol=1e-10)


def test_equator_row_is_the_planar_convolution() -> None:
    """An odd height has a row on the equator, whose taps are the centres of pixels, but for those above and below."""
    images, weight = random_values(1, 2, 31, 60), random_values(3, 2, 3, 3)
    planar = F.conv2d(equirectangular_pad(images, 1), weight)
    torch.testing.assert_close(sphere_conv2d(images, weight)[..., 15, :], planar[..., 15, :])


def test_groups_are_convolutions_apart() -> None:
    images, weight = random_values(1, 4, 8, 16), random_values(6, 2, 3, 3)
    apart = [sphere_conv2d(images[:, 2 * g : 2 * g + 2], weight[3 * g : 3 * g + 3]) for g in range(2)]
    torch.testing.assert_close(sphere_conv2d(images, weight, groups=2), torch.cat(apart, 1))


def test_weights_are_those_of_a_planar_convolution() -> None:
    planar, sphere = nn.Conv2d(3, 8, 5, groups=1), SphereConv2d(3, 8, 5)
    sphere.load_state_dict(planar.state_dict())
    assert torch.equal(sphere.weight, planar.weight)
    planar.load_state_dict(SphereConv2d(3, 8, 5).state_dict())
    assert isinstance(sphere, nn.Conv2d)
