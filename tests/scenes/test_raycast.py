# SPDX-License-Identifier: Apache-2.0
"""Rays against primitives: laws of hits, normals and shadows, and the names of what they hit."""

import math

import pytest
import torch
from torch import Tensor

from sphericalvision.icosphere import icosphere_vertices
from sphericalvision.scenes import SURFACE_LABELS, make_scene, ray_depth, ray_labels
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


@pytest.fixture(scope="module")
def directions() -> torch.Tensor:
    return icosphere_vertices(4).float()


def test_floors_are_below_and_ceilings_above(directions: torch.Tensor) -> None:
    found = set()
    for seed in range(4):
        scene = make_scene("room", seed)
        labels = ray_labels(scene, torch.zeros(3), directions)
        depth = ray_depth(scene, torch.zeros(3), directions)
        assert torch.equal(labels < 0, depth.isinf())
        assert labels.max() < len(SURFACE_LABELS)
        height = directions[:, 1]
        floor, ceiling, wall = (labels == SURFACE_LABELS.index(n) for n in ("floor", "ceiling", "wall"))
        assert floor[height > 0.95].float().mean() > 0.3
        assert not floor[height < 0].any()
        assert not ceiling[height > 0].any()
        # Floor and ceiling are planes: the rays' ends are all at one height, or, next door, at a second one.
        for plane in (floor, ceiling):
            ends = (depth * height)[plane]
            assert len(ends.mul(100).round().unique()) <= 4
        assert wall.float().mean() > 0.1
        found |= set(labels.unique().tolist())
    named = {SURFACE_LABELS[label] for label in found if label >= 0}
    assert {"floor", "ceiling", "wall", "seat", "storage", "picture", "lamp"} <= named


def test_labels_move_with_the_scene(directions: torch.Tensor) -> None:
    scene, shift = make_scene("room", 2), torch.tensor([0.3, -0.1, 0.2])
    turn = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    moved = ray_labels(scene.transformed(turn, shift).scaled(2.0), 2 * shift, directions @ turn.T)
    assert (moved == ray_labels(scene, torch.zeros(3), directions)).float().mean() > 0.999


def test_what_has_no_name_is_other() -> None:
    assert pack([Part("box", (0.0, 0.0, 2.0), (0.5, 0.5, 0.5))]).label.tolist() == [0]
    assert SURFACE_LABELS[0] == "other"
