# SPDX-License-Identifier: Apache-2.0
"""Padding of panoramas and cube maps against the directions that padded places look in, and seam-free networks."""

import math

import pytest
import torch
from torch import Tensor, nn

from sphericalvision.geometry import directions_from_longitude_latitude
from sphericalvision.sphere import (
    Cubemap,
    CubePad2d,
    Equirectangular,
    EquirectangularPad2d,
    SphereConv2d,
    cube_pad,
    equirectangular_pad,
    make_seamless,
)
from sphericalvision.sphere.grids.cube_layouts import world_from_cube_face
from tests.values import random_values


@pytest.mark.parametrize("size", [(4, 8), (5, 10), (4, 7)])
@pytest.mark.parametrize("padding", [1, (2, 3, 1, 4)])
def test_panoramas_continue_where_longitude_and_latitude_lead(
    size: tuple[int, int], padding: int | tuple[int, int, int, int]
) -> None:
    (height, width), images = size, random_values(2, 3, *size)
    left, right, top, bottom = (padding,) * 4 if isinstance(padding, int) else padding
    column = torch.arange(-left, width + right, dtype=torch.float64)
    row = torch.arange(-top, height + bottom, dtype=torch.float64)[:, None]
    directions = directions_from_longitude_latitude(
        (column + 0.5) * (2 * math.pi / width) - math.pi, math.pi / 2 - (row + 0.5) * (math.pi / height)
    )
    grid = Equirectangular(*size, dtype=torch.float64)
    expected = grid.sample(images, directions.view(-1, 3)).view(2, 3, *directions.shape[:2])
    torch.testing.assert_close(equirectangular_pad(images, padding), expected)
    torch.testing.assert_close(EquirectangularPad2d(padding)(images[0]), expected[0])


@pytest.mark.parametrize("padding", [1, 3, (2, 0, 1, 3)])
@pytest.mark.parametrize("size", [3, 4])
def test_cube_maps_continue_on_the_unfolded_neighbor(
    size: int, padding: int | tuple[int, int, int, int]
) -> None:
    """A place d beyond an edge is on the neighbour, d below the edge: walk there on the cube and look it up."""
    faces, grid = random_values(2, 3, 6, size, size), Cubemap(size, dtype=torch.float64)
    left, right, top, bottom = (padding,) * 4 if isinstance(padding, int) else padding
    padded = cube_pad(faces, padding)
    assert padded.shape[-2:] == (top + size + bottom, left + size + right)
    for face, axes in enumerate(world_from_cube_face(torch.float64)):
        for i in range(-top, size + bottom):
            for j in range(-left, size + right):
                x, y = (2 * j + 1) / size - 1, (2 * i + 1) / size - 1
                outside_x, outside_y = max(abs(x) - 1, 0), max(abs(y) - 1, 0)
                if outside_x and outside_y:
                    inner_x, inner_y = (max(min(t, 1 - 1 / size), 1 / size - 1) for t in (x, y))
                    places = [(x, inner_y), (inner_x, y)]
                else:
                    places = [(x, y)]
                expected = torch.zeros(2, 3, dtype=torch.float64)
                for px, py in places:
                    beyond = max(abs(px), abs(py), 1) - 1
                    local = torch.tensor([max(min(px, 1), -1), max(min(py, 1), -1), 1 - beyond]).double()
                    index = grid.nearest(axes @ local)
                    expected += faces.flatten(-3)[..., index] / len(places)
                torch.testing.assert_close(padded[:, :, face, top + i, left + j], expected)


def test_cube_padding_in_the_batch_is_the_same() -> None:
    faces = random_values(2, 6, 6, 4, 4)  # six channels, too: the layout is told by the number of dimensions
    expected = cube_pad(faces, 1)
    in_batch = CubePad2d(1)(faces.transpose(1, 2).flatten(0, 1))
    torch.testing.assert_close(in_batch.unflatten(0, (2, 6)).transpose(1, 2), expected)


def quarter_turn(faces: Tensor) -> Tensor:
    """A yaw of 90° of cube maps ``(B, C, 6, S, S)``."""
    front, right, back, left, up, down = faces.unbind(2)
    turned = (left, front, right, back, up.rot90(1, (-2, -1)), down.rot90(-1, (-2, -1)))
    return torch.stack(turned, 2)


def test_quarter_turn_is_a_rotation_of_the_cube() -> None:
    directions = Cubemap(4, dtype=torch.float64).directions.movedim(-1, 0)[None]
    turned = quarter_turn(directions)[0]
    torch.testing.assert_close(turned, torch.stack((-directions[0, 2], directions[0, 1], directions[0, 0])))


def test_isotropic_networks_on_padded_cubes_commute_with_quarter_turns() -> None:
    network = nn.Sequential(nn.Conv2d(2, 4, 3, padding=1), nn.ReLU(), nn.MaxPool2d(3, 1, 1)).double()
    kernel = torch.tensor([[1.0, 2.0, 1.0], [2.0, 3.0, 2.0], [1.0, 2.0, 1.0]], dtype=torch.float64)
    network[0].weight.data.copy_(random_values(4, 2, 1, 1) * kernel)
    network = make_seamless(network, CubePad2d)

    def run(faces: Tensor) -> Tensor:
        return network(faces.transpose(1, 2).flatten(0, 1)).unflatten(0, (-1, 6)).transpose(1, 2)

    faces = random_values(1, 2, 6, 5, 5)
    torch.testing.assert_close(run(quarter_turn(faces)), quarter_turn(run(faces)))


class Block(nn.Module):
    """A residual block whose layers are attributes."""

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Conv2d(4, 4, 3, padding="same", dilation=2, padding_mode="zeros")
        self.second = nn.Conv2d(4, 4, (1, 5), padding=(0, 2), groups=2, bias=False)
        self.norm = nn.BatchNorm2d(4)

    def forward(self, images: Tensor) -> Tensor:
        return torch.relu(images + self.norm(self.second(torch.relu(self.first(images)))))


def planar_network() -> nn.Sequential:
    torch.manual_seed(0)
    return nn.Sequential(
        nn.Conv2d(2, 4, 5, padding=2, padding_mode="reflect"),
        Block(),
        nn.MaxPool2d((3, 5), 1, (1, 2)),
        nn.Sequential(nn.ZeroPad2d((2, 2, 1, 1)), nn.Conv2d(4, 4, (3, 5)), nn.AvgPool2d((5, 3), 1, (2, 1))),
        SphereConv2d(4, 4),
        nn.Conv2d(4, 3, 1),
    ).double()


def test_rolling_commutes_with_a_network_made_circular() -> None:
    images, planar = random_values(2, 2, 8, 13), planar_network().eval()
    unlike = (planar(images.roll(5, -1)) - planar(images).roll(5, -1)).abs().max()
    assert unlike > 0.01
    network = make_seamless(planar)
    expected = network(images)
    for yaw in range(13):
        torch.testing.assert_close(network(images.roll(yaw, -1)), expected.roll(yaw, -1))


def test_upside_down_commutes_with_a_symmetric_network_made_circular() -> None:
    """Over the poles as across the seam: a turn about the forward axis by 180° is both flips."""
    network = make_seamless(planar_network().eval())
    for layer in network.modules():
        if getattr(layer, "weight", None) is not None and layer.weight.ndim == 4:
            layer.weight.data.copy_((layer.weight + layer.weight.flip(-1, -2)) / 2)
    images = random_values(1, 2, 8, 16)
    torch.testing.assert_close(network(images.flip(-1, -2)), network(images).flip(-1, -2))


def test_a_network_made_circular_keeps_its_parameters_and_its_inside() -> None:
    planar = planar_network().eval()
    state, images = planar.state_dict(), random_values(1, 2, 32, 64)
    inside = planar[:3](images)
    parameters = dict(planar.named_parameters())
    network = make_seamless(planar)
    assert network is planar
    assert all(parameters[name] is value for name, value in network.named_parameters())
    assert list(network.state_dict()) == list(state)
    network.load_state_dict(planar_network().state_dict())
    torch.testing.assert_close(network[:3](images)[..., 8:-8, 8:-8], inside[..., 8:-8, 8:-8])


def test_a_single_layer_is_replaced() -> None:
    layer = make_seamless(nn.Conv2d(2, 3, 3, padding=1))
    images = torch.rand(1, 2, 4, 8)
    torch.testing.assert_close(layer(images.roll(3, -1)), layer(images).roll(3, -1))
