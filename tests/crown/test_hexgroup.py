# SPDX-License-Identifier: Apache-2.0
"""Convolutions in six orientations: turned pictures give turned results; each orientation is a plain convolution."""

import torch
from torch import Tensor, nn

from sphericalvision.crown import (
    HexGroupConv2d,
    HexLiftConv2d,
    hex_conv2d,
    hex_group_conv2d,
    hex_lift_conv2d,
    north_fraction,
)
from sphericalvision.icosphere import Icosphere
from tests.laws.grid_laws import rotation_about
from tests.values import random_values

DOUBLE = torch.float64
LEVEL = 4
TAPS = ((0, -1), (1, -1), (1, 0), (0, 1), (-1, 1), (-1, 0))
"""(row, column) of the ring in a chart, as the module of hexagonal convolutions says."""


def vertex(row: int, column: int, chart: int = 2) -> int:
    n = 2**LEVEL
    return 1 + (chart * 2 * n + row) * n + column


def turned_in_chart(values: Tensor, row: int, column: int, reach: int) -> tuple[Tensor, Tensor]:
    """Values about a vertex, zero elsewhere, and the same turned by one neighbour about it: tap k goes to tap k + 1."""
    before, after = torch.zeros_like(values), torch.zeros_like(values)
    for r in range(-reach, reach + 1):
        for c in range(-reach, reach + 1):
            if abs(r + c) <= reach:
                there = vertex(row + r, column + c)
                before[..., there] = values[..., there]
                after[..., vertex(row - c, column + r + c)] = values[..., there]
    return before, after


def test_turns_of_the_lattice_take_each_tap_to_the_next() -> None:
    assert [(-c, r + c) for r, c in TAPS] == [*TAPS[1:], TAPS[0]]


def test_a_turned_picture_gives_turned_values_one_orientation_on() -> None:
    """Exactly, inside a chart, through two layers."""
    before, after = turned_in_chart(random_values(1, 3, Icosphere(LEVEL).num_vertices), 14, 8, 4)
    lift, group = random_values(4, 3, 7, seed=1), random_values(5, 4, 6, 7, seed=2)

    def network(values: Tensor) -> Tensor:
        return hex_group_conv2d(hex_lift_conv2d(values, lift).relu(), group)

    expected, turned = turned_in_chart(network(before), 14, 8, 6)
    found, _ = turned_in_chart(network(after), 14, 8, 6)
    torch.testing.assert_close(found, turned.roll(1, 2), rtol=0, atol=1e-12)
    assert (found - expected).abs().max() > 1


def test_each_orientation_is_a_plain_convolution() -> None:
    values, lift = random_values(2, 3, 162), random_values(4, 3, 7, seed=1)
    north = north_fraction(2, DOUBLE)
    found = hex_lift_conv2d(values, lift, north=north)
    torch.testing.assert_close(found[:, :, 0], hex_conv2d(values, lift, north=north))
    twice = lift[..., [4, 5, 0, 1, 2, 3, 6]]
    torch.testing.assert_close(found[:, :, 2], hex_conv2d(values, twice, north=north))
    group = random_values(5, 4, 6, 7, seed=2)
    first = hex_group_conv2d(found, group, stride=2, north=north)[:, :, 0]
    plain = hex_conv2d(found.flatten(1, 2), group.flatten(1, 2), stride=2, north=north)
    torch.testing.assert_close(first, plain)


def test_a_picture_turned_in_its_place_is_nearly_the_same_to_a_network() -> None:
    """By 60° about a vertex of the belt: the largest of six orientations stays, what a plain network says does not."""
    ico = Icosphere(5, dtype=DOUBLE)
    axis = ico.vertices[(ico.vertices[:, 1].abs() + (ico.vertices[:, 2] - 1).abs()).argmin()]
    turn = rotation_about(axis, torch.pi / 3)
    waves = random_values(6, 3, seed=3) * 9

    def picture(directions: Tensor) -> Tensor:
        near = (30 * (directions @ axis - 1)).exp()
        return ((directions @ waves.T).sin().sum(-1) * near)[None, None]

    north = north_fraction(5, DOUBLE)
    lift, group = random_values(8, 1, 7, seed=1), random_values(8, 8, 6, 7, seed=2)
    lift = lift - lift.mean(-1, keepdim=True)  # sees edges, not brightness

    def in_six(values: Tensor) -> Tensor:
        return hex_group_conv2d(hex_lift_conv2d(values, lift, north=north).relu(), group, north=north).amax(2)

    def plain(values: Tensor) -> Tensor:
        first = hex_conv2d(values, lift, north=north).relu()
        return hex_conv2d(first, group[:, :, 0], north=north)

    def change(network: object) -> float:
        one, other = (network(picture(d)).sum(-1) for d in (ico.vertices, ico.vertices @ turn))  # type: ignore[operator]
        return float((one - other).norm() / one.norm())

    assert change(in_six) < 0.015
    assert change(plain) > 0.4


def test_modules_learn_and_say_what_they_are() -> None:
    network = nn.Sequential(HexLiftConv2d(2, 3, level=2), nn.ReLU(), HexGroupConv2d(3, 4, level=2, stride=2))
    network(torch.randn(1, 2, 162)).amax(2).square().sum().backward()
    assert all(p.grad is not None and p.grad.abs().max() > 0 for p in network.parameters())
    assert str(network[2]) == "HexGroupConv2d(3, 4, level=2, stride=2)"
    assert set(network.state_dict()) == {"0.weight", "2.weight"}
