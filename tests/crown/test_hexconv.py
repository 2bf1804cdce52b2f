# SPDX-License-Identifier: Apache-2.0
"""Hexagonal convolutions on vertices against a loop over true neighbours, and their laws under rotations."""

import math

import pytest
import torch
from torch import Tensor

from sphericalvision.crown import (
    CrownConv2d,
    CrownConv3d,
    HexConv2d,
    HexConv3d,
    crown_conv2d,
    from_crown,
    hex_conv2d,
    hex_conv3d,
    north_fraction,
    to_crown,
)
from sphericalvision.icosphere import (
    Icosphere,
    icosphere_neighbors,
    icosphere_vertices,
    num_icosphere_vertices,
)
from sphericalvision.icosphere.topology import coarse_vertex_ids, vertex_at
from tests.laws.grid_laws import UP, icosahedral_rotations, rotation_about
from tests.values import random_values

# The gap and where the ring starts, as the documentation states it for valence five: (gap, tap, towards).
CHART_GAPS = {"north": (1, 2, "A0"), "A": (0, 5, "north"), "B": (2, 3, "south"), "south": (4, 5, "B1")}
NORTH_GAPS = {"north": (5, 2, "A0"), "A": (2, 5, "north"), "B": (5, 2, "south"), "south": (5, 2, "B3")}


def round_from_inside(neighbors: list[int], start: int) -> list[int]:
    """Neighbours from ``start`` on, counter-clockwise from inside; the table has them so from outside."""
    around = [v for v in neighbors if v >= 0][::-1]
    turn = around.index(start)
    return around[turn:] + around[:turn]


def azimuth(center: Tensor, towards: Tensor) -> float:
    """Angle from north, counter-clockwise from inside, of a direction seen from a place that is no pole."""
    up = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    # Looking outwards with up on top, right is ``center x up``: forward (+z) and up (-y) give +x.
    right = torch.linalg.cross(center, up)
    right = right / right.norm()
    top = torch.linalg.cross(right, center)
    return math.atan2(-float(towards @ right), float(towards @ top)) % (2 * math.pi)


def tap_table(level: int, orientation: str) -> Tensor:
    """Weight of every vertex in the six taps around every vertex, ``(V, 6, V)``, by a loop."""
    n, vertices = 2**level, icosphere_vertices(level, torch.float64)
    neighbors = icosphere_neighbors(level).tolist()
    table = torch.zeros(len(vertices), 6, len(vertices), dtype=torch.float64)
    corners = icosphere_vertices(0, torch.float64)
    ring_of_corners = {"north": corners[0], "south": corners[-1]}
    for k in range(5):
        ring_of_corners[f"A{k}"], ring_of_corners[f"B{k}"] = corners[1 + 2 * k], corners[2 + 2 * k]

    def special(vertex: int, kind: str) -> None:
        gap, tap, towards = (CHART_GAPS if orientation == "chart" else NORTH_GAPS)[kind]
        around = [v for v in neighbors[vertex] if v >= 0]
        start = max(around, key=lambda v: float(vertices[v] @ ring_of_corners[towards]))
        ring = iter(round_from_inside(around, start))
        for step in range(6):
            if (tap + step) % 6 == gap:
                table[vertex, gap, around] = 1 / 5
            else:
                table[vertex, (tap + step) % 6, next(ring)] = 1

    special(0, "north")
    special(len(vertices) - 1, "south")
    for k in range(5):
        for row in range(1, 2 * n + 1):
            for column in range(n):
                vertex = 1 + (k * 2 * n + row - 1) * n + column
                if row % n == 0 and column == 0:
                    special(vertex, "A" if row == n else "B")
                elif orientation == "chart":
                    above = vertex_at(*map(torch.tensor, (k, row - 1, column)), level).item()
                    for step, v in enumerate(round_from_inside(neighbors[vertex], int(above))):
                        table[vertex, (5 + step) % 6, v] = 1
                else:
                    angles = {v: azimuth(vertices[vertex], vertices[v]) for v in neighbors[vertex]}
                    # The last neighbour before north, or the one that is north up to rounding.
                    before = max(angles, key=lambda v: angles[v])
                    if min(angles.values()) < 1e-9 or max(angles.values()) > 2 * math.pi - 1e-9:
                        before = min(angles, key=lambda v: min(angles[v], 2 * math.pi - angles[v]))
                        angles[before] = 0.0
                    ring = round_from_inside(neighbors[vertex], before)
                    to_north = (-angles[before]) % (2 * math.pi)
                    step_angle = (angles[ring[1]] - angles[before]) % (2 * math.pi)
                    fraction = to_north / step_angle
                    for step in range(6):
                        table[vertex, (5 + step) % 6, ring[step]] += 1 - fraction
                        table[vertex, (5 + step) % 6, ring[(step + 1) % 6]] += fraction
    return table


def loop_convolution(values: Tensor, weight: Tensor, table: Tensor) -> Tensor:
    """Seven taps ``(out, in, 7)`` at every vertex of ``(B, in, V)``."""
    around = torch.einsum("vtu,biu->bivt", table, values)
    return torch.einsum("bivt,oit->bov", torch.cat((around, values[..., None]), -1), weight)


def permutation(rotation: Tensor, level: int) -> Tensor:
    """For every vertex the vertex that the rotation brings there."""
    vertices = icosphere_vertices(level, torch.float64)
    closeness, came_from = (vertices @ rotation @ vertices.T).max(1)
    assert closeness.min() > 1 - 1e-12
    return came_from


def isotropic(out_channels: int, in_channels: int, depths: int = 1) -> Tensor:
    kernel = random_values(out_channels, in_channels, depths, 2)
    ring = kernel[..., :1].expand(-1, -1, -1, 6)
    return torch.cat((ring, kernel[..., 1:]), -1).flatten(2)


@pytest.mark.parametrize("orientation", ["chart", "north"])
@pytest.mark.parametrize("level", [0, 1, 2, 3])
def test_conv2d_agrees_with_a_loop_over_neighbors(level: int, orientation: str) -> None:
    values = random_values(2, 3, num_icosphere_vertices(level))
    weight, bias = random_values(4, 3, 7), random_values(4)
    north = north_fraction(level, torch.float64) if orientation == "north" else None
    expected = loop_convolution(values, weight, tap_table(level, orientation)) + bias[:, None]
    torch.testing.assert_close(hex_conv2d(values, weight, bias, north=north), expected, rtol=0, atol=1e-12)
    if level > 0:
        coarse = hex_conv2d(values, weight, bias, 2, north)
        torch.testing.assert_close(coarse, expected[..., coarse_vertex_ids(level)], rtol=0, atol=1e-12)


@pytest.mark.parametrize("orientation", ["chart", "north"])
@pytest.mark.parametrize("stride", [1, 2])
def test_conv3d_is_three_conv2d(orientation: str, stride: int) -> None:
    values, weight, bias = random_values(2, 3, 4, 162), random_values(5, 3, 21), random_values(5)
    north = north_fraction(2, torch.float64) if orientation == "north" else None
    result = hex_conv3d(values, weight, bias, stride, north)
    for j in range(4):
        expected = sum(
            hex_conv2d(
                values[:, :, min(max(j + d - 1, 0), 3)], weight[..., 7 * d : 7 * d + 7], None, stride, north
            )
            for d in range(3)
        )
        torch.testing.assert_close(result[:, :, j], expected + bias[:, None])


def test_along_charts_it_is_the_crown_convolution_inside_of_col_rectangles() -> None:
    values, weight = random_values(2, 3, 642), random_values(4, 3, 7)
    ours = to_crown(hex_conv2d(values, weight)).col
    theirs = crown_conv2d(to_crown(values), weight).col
    torch.testing.assert_close(ours[..., 1:-1, 1:-1], theirs[..., 1:-1, 1:-1])


@pytest.mark.parametrize("level", [1, 2, 4])
def test_north_lies_between_two_neighbors(level: int) -> None:
    fraction, n = north_fraction(level, torch.float64)[1:-1].view(5, 2 * 2**level, 2**level), 2**level
    assert fraction.min() >= 0
    assert fraction.max() <= 1
    assert fraction[:, :n, 0].abs().max() < 1e-12  # the west edge of a polar face is a meridian
    middle = fraction[:, n - 1, 1:].mean()  # the upper ring, in the middle of the belt
    assert abs(middle - 0.5) < 0.1
    torch.testing.assert_close(fraction, fraction[:1].expand_as(fraction))  # all charts are alike


@pytest.mark.parametrize("orientation", ["chart", "north"])
def test_isotropic_kernels_commute_with_the_sixty_rotations(orientation: str) -> None:
    level = 2
    values, volumes = random_values(1, 3, 162), random_values(1, 2, 3, 162)
    north = north_fraction(level, torch.float64) if orientation == "north" else None
    weight, weight3d = isotropic(4, 3), isotropic(4, 2, 3)
    plain, strided = (hex_conv2d(values, weight, None, stride, north) for stride in (1, 2))
    deep = hex_conv3d(volumes, weight3d, None, 1, north)
    for rotation in icosahedral_rotations(Icosphere(0)):
        turned, coarse = permutation(rotation, level), permutation(rotation, level - 1)
        for result, expected in (
            (hex_conv2d(values[..., turned], weight, None, 1, north), plain[..., turned]),
            (hex_conv2d(values[..., turned], weight, None, 2, north), strided[..., coarse]),
            (hex_conv3d(volumes[..., turned], weight3d, None, 1, north), deep[..., turned]),
        ):
            torch.testing.assert_close(result, expected, rtol=0, atol=1e-12)


def test_crown_convolutions_do_not_commute_with_rotations() -> None:
    """Their copied borders are what ``HexConv2d`` is there to avoid; smooth functions hide them, noise shows them."""
    values, weight = random_values(1, 1, 162), isotropic(1, 1)

    def convolve(values: Tensor) -> Tensor:
        return from_crown(crown_conv2d(to_crown(values), weight))

    plain = convolve(values)
    errors = [
        (convolve(values[..., turned]) - plain[..., turned]).abs().max()
        for turned in (permutation(rotation, 2) for rotation in icosahedral_rotations(Icosphere(0)))
    ]
    assert max(errors) > 0.05 * plain.std()
    fivefold = [error for error in errors if error < 1e-12]
    assert len(fivefold) == 10  # turns about the poles by 72°, upside down or not


@pytest.mark.parametrize("orientation", ["chart", "north"])
def test_any_kernel_commutes_with_a_fifth_of_a_turn_but_at_the_poles(orientation: str) -> None:
    values, weight = random_values(1, 2, 162), random_values(3, 2, 7)
    north = north_fraction(2, torch.float64) if orientation == "north" else None
    turned = permutation(rotation_about(UP, 2 * math.pi / 5), 2)
    result = hex_conv2d(values[..., turned], weight, north=north)
    expected = hex_conv2d(values, weight, north=north)[..., turned]
    torch.testing.assert_close(result[..., 1:-1], expected[..., 1:-1], rtol=0, atol=1e-12)


def test_channels_are_the_fastest_in_memory_whatever_comes_in() -> None:
    layer, values = HexConv2d(3, 5, bias=True).double(), random_values(2, 3, 162)
    for given in (values, values.mT.contiguous().mT):
        assert layer(given).stride(1) == 1


def test_modules() -> None:
    layer = HexConv2d(3, 5, stride=2, bias=True)
    for planar, volume in ((HexConv2d, HexConv3d), (CrownConv2d, CrownConv3d)):
        assert planar(3, 5).weight.shape == (5, 3, 7)
        assert volume(3, 5).weight.shape == (5, 3, 21)
        assert list(planar(3, 5).state_dict()) == ["weight"]
        assert planar(3, 500).weight.abs().max().item() == pytest.approx((3 * 7) ** -0.5, rel=0.01)
    assert list(layer.state_dict()) == ["weight", "bias"]
    aligned = HexConv2d(3, 5, stride=2, bias=True, orientation="north", level=2)
    aligned.load_state_dict(layer.state_dict())  # tables are no state
    values = torch.rand(1, 3, 162)
    torch.testing.assert_close(
        aligned(values), hex_conv2d(values, layer.weight, layer.bias, 2, north_fraction(2))
    )
    CrownConv2d(3, 5, bias=True).load_state_dict(layer.state_dict())
