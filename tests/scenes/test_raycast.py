# SPDX-License-Identifier: Apache-2.0
"""Rays against primitives: laws of hits, normals and shadows."""

import math

import pytest
import torch
from torch import Tensor

from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.scenes.rendering.primitives import SHAPES, Part, Primitives, map_columns, pack
from sphericalvision.scenes.rendering.ray_packets import RayPackets, packed
from sphericalvision.scenes.rendering.raycast import blocked, first_hits, trace
from sphericalvision.scenes.rendering.shading import normals_and_uv


def unit_vectors(count: int, generator: torch.Generator) -> Tensor:
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)


def in_double(primitives: Primitives) -> Primitives:
    return map_columns(lambda column: column.double() if column.is_floating_point() else column, primitives)


def packets(origins: Tensor, directions: Tensor) -> RayPackets:
    """Rays with an origin each, or one for all."""
    start = packed(origins.T.contiguous()) if origins.ndim > 1 else origins[:, None, None]
    return RayPackets(start, packed(directions.T.contiguous()))


def trace_each(primitives: Primitives, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Distances and rows, from an origin for each ray."""
    found = first_hits(primitives, packets(origins, directions))
    return found[0].flatten()[: len(directions)], found[1].flatten()[: len(directions)]


def random_primitives(count: int, generator: torch.Generator, shapes: tuple[str, ...] = SHAPES) -> Primitives:
    """Primitives of all attitudes between 2 and 6 m from the origin."""
    parts = []
    for k in range(count):
        center = unit_vectors(1, generator)[0] * (2 + 4 * torch.rand((), generator=generator))
        half = 0.2 + 0.8 * torch.rand(3, generator=generator)
        rotation, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator))
        shape = shapes[k % len(shapes)]
        parts.append(Part(shape, tuple(center.tolist()), tuple(half.tolist()), rotation=rotation.tolist()))
    return pack(parts)


def test_more_rays_than_a_chunk_in_any_shape(generator: torch.Generator) -> None:
    primitives, directions = random_primitives(5, generator), unit_vectors(20000, generator)
    whole = trace(primitives, torch.zeros(3), directions.reshape(100, 200, 3))
    assert whole.distance.shape == (100, 200)
    part = trace(primitives, torch.zeros(3), directions[15000:15100])
    torch.testing.assert_close(whole.distance.flatten()[15000:15100], part.distance)
    assert trace(primitives, torch.zeros(3), torch.zeros(0, 3)).distance.shape == (0,)


def test_moving_scene_and_ray_together_changes_nothing(generator: torch.Generator) -> None:
    primitives, directions = random_primitives(20, generator), unit_vectors(1000, generator)
    rotation, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator))
    shift = torch.tensor([1.0, 2.0, -3.0])
    moved = trace(primitives.transformed(rotation, shift), shift, directions @ rotation.T)
    still = trace(primitives, torch.zeros(3), directions)
    same = moved.primitive == still.primitive
    assert same.float().mean() > 0.995
    torch.testing.assert_close(moved.distance[same], still.distance[same], rtol=1e-3, atol=1e-3)
    twice = trace(primitives.scaled(2.0), torch.zeros(3), directions)
    torch.testing.assert_close(twice.distance, 2 * still.distance, rtol=1e-4, atol=1e-4)


def test_normals_are_unit_face_the_ray_and_stand_on_the_surface(generator: torch.Generator) -> None:
    primitives = in_double(random_primitives(30, generator))
    directions = unit_vectors(4000, generator).double()
    origin = torch.zeros(3, dtype=torch.float64)
    hit = trace(primitives, origin, directions)
    met = hit.primitive >= 0
    rays, distance, row = directions[met], hit.distance[met], hit.primitive[met]
    position = distance[:, None] * rays
    normal = normals_and_uv(primitives, position.T.contiguous(), rays.T.contiguous(), row)[0].T
    torch.testing.assert_close(normal.norm(dim=-1), torch.ones_like(distance))
    assert ((normal * rays).sum(-1) <= 0).all()
    # A tangent step stays on the surface to first order: the distance along the normal to a solid is the ray's hit.
    back, back_row = trace_each(primitives, position + 0.01 * normal, -normal)
    torch.testing.assert_close(back[back_row == row].median(), torch.tensor(0.01).double())
    assert (back <= 0.01 + 1e-9).all()


def shadowed(primitives: Primitives, directions: Tensor, limits: Tensor) -> Tensor:
    """Whether something stands on each ray from the world's origin before its limit."""
    return blocked(primitives, packets(torch.zeros(3), directions), packed(limits)).flatten()[: len(limits)]


def test_blocked_is_a_hit_before_the_limit(generator: torch.Generator) -> None:
    primitives, directions = random_primitives(30, generator), unit_vectors(3000, generator)
    limits = 1 + 5 * torch.rand(3000, generator=generator)
    expected = trace(primitives, torch.zeros(3), directions).distance < limits
    assert 0.05 < expected.float().mean() < 0.95
    assert torch.equal(shadowed(primitives, directions, limits), expected)


def test_convention_yaw_turns_forward_towards_right() -> None:
    """A long box along its own z, turned by a quarter, lies along x."""
    box = pack([Part("box", (0.0, 0.0, 0.0), (0.1, 0.1, 2.0), yaw=math.pi / 2)])
    directions = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    torch.testing.assert_close(trace(box, torch.zeros(3), directions).distance, torch.tensor([2.0, 0.1]))
    turned = pack([Part("box", (0.0, 0.0, 0.0), (0.1, 0.1, 2.0), yaw=math.pi / 4)])
    right_and_forward = torch.tensor([math.sqrt(0.5), 0.0, math.sqrt(0.5)])
    torch.testing.assert_close(trace(turned, torch.zeros(3), right_and_forward).distance, torch.tensor(2.0))


def test_distance_from_a_point_is_to_the_bounding_box() -> None:
    table = pack(
        [Part("box", (0.0, 0.0, 3.0), (1.0, 1.0, 1.0)), Part("rectangle", (0.0, 2.0, 3.0), (1.0, 1.0, 9.0))]
    )
    torch.testing.assert_close(table.distance_from(torch.zeros(3)), torch.tensor([2.0, math.sqrt(1 + 9)]))


def test_bad_arguments_are_named() -> None:
    ball = pack([Part("ellipsoid", (0.0, 0.0, 3.0), (1.0, 1.0, 1.0))])
    with pytest.raises(ShapeError, match="directions"):
        trace(ball, torch.zeros(3), torch.zeros(4, 2))
    with pytest.raises(ArgumentError, match="shape"):
        pack([Part("cone", (0.0, 0.0, 3.0), (1.0, 1.0, 1.0))])
    with pytest.raises(ArgumentError, match="half"):
        pack([Part("box", (0.0, 0.0, 3.0), (1.0, 0.0, 1.0))])
    with pytest.raises(ArgumentError, match="parts"):
        pack([])
