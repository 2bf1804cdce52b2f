# SPDX-License-Identifier: Apache-2.0
"""Rotation as an augmentation: everything turns together, is repeated and undone."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import ring_rig
from sphericalvision.data import RandomSphereRotation, RandomYaw, random_rotations
from sphericalvision.data.augmentation.sphere_rotation import (
    num_yaw_steps,
    rotate_on_sphere,
    yaw_on_sphere,
    yaw_rotation,
)
from sphericalvision.icosphere import Icosphere
from sphericalvision.sphere import Cubemap, Equirectangular, Healpix, SphereGrid
from tests.values import weighted_sum

GRIDS = [
    Equirectangular(24, 48, torch.float64),
    Icosphere(3, torch.float64),
    Cubemap(12, torch.float64),
    Healpix(8, dtype=torch.float64),
]


def ids(grid: SphereGrid) -> str:
    return type(grid).__name__


def smooth(directions: Tensor) -> Tensor:
    """Three smooth functions of directions ``(*, 3)`` as channels ``(3, *)``."""
    x, y, z = directions.unbind(-1)
    return torch.stack((x * y + z, y * y - x, x * z - y))


@pytest.mark.parametrize("grid", GRIDS, ids=ids)
def test_images_show_the_rotated_function(grid: SphereGrid, generator: torch.Generator) -> None:
    """What stood in d stands in R d: the image of f is that of f(R⁻¹ d)."""
    turns = random_rotations(3, generator=generator).double()
    image = smooth(grid.directions).expand(3, 3, *grid.shape)
    expected = torch.stack([smooth(grid.directions @ turn) for turn in turns])
    moved = rotate_on_sphere(image, grid, turns)
    assert moved.shape == image.shape
    assert (moved - expected).abs().max() < 0.05
    for k in range(3):
        torch.testing.assert_close(rotate_on_sphere(image[k], grid, turns[k]), moved[k])


@pytest.mark.parametrize("grid", GRIDS, ids=ids)
def test_normals_turn_with_what_they_stand_on(grid: SphereGrid, generator: torch.Generator) -> None:
    """Normals that point outwards point outwards after any rotation; zeros stay zeros."""
    outwards = grid.directions.movedim(-1, 0)
    turn = random_rotations(1, generator=generator)[0].double()
    moved = rotate_on_sphere(outwards, grid, turn, "normals")
    torch.testing.assert_close(moved.norm(dim=0), torch.ones(grid.shape, dtype=torch.float64))
    assert (moved * outwards).sum(0).min() > 0.995
    assert (rotate_on_sphere(torch.zeros_like(outwards), grid, turn, "normals") == 0).all()


@pytest.mark.parametrize("grid", GRIDS, ids=ids)
@pytest.mark.parametrize("kind", ["depth", "labels"])
def test_depth_and_labels_are_those_of_the_nearest_place(
    grid: SphereGrid, kind: str, generator: torch.Generator
) -> None:
    """Infinity is no trouble, and any dtype will do."""
    values = torch.randint(0, 9, grid.shape, generator=generator)
    values = torch.where(values == 8, torch.inf, values.double()) if kind == "depth" else values
    turn = random_rotations(1, generator=generator)[0].double()
    moved = rotate_on_sphere(values, grid, turn, kind)
    assert torch.equal(moved, values.flatten()[grid.nearest(grid.directions @ turn)])
    assert moved.dtype == values.dtype


@pytest.mark.parametrize("grid", GRIDS, ids=ids)
def test_a_turn_of_the_grid_is_exact(grid: SphereGrid) -> None:
    """A step moves each value onto a place where the grid has one: nothing is lost in a full turn."""
    count = num_yaw_steps(grid)
    turn = yaw_rotation(torch.tensor(2 * math.pi / count, dtype=torch.float64))
    moved = yaw_on_sphere(grid.directions.movedim(-1, 0), grid, 1, "image").movedim(0, -1)
    torch.testing.assert_close(moved, grid.directions @ turn, rtol=0, atol=1e-12)
    values = torch.arange(math.prod(grid.shape)).view(grid.shape)
    assert torch.equal(yaw_on_sphere(values, grid, count, "labels"), values)
    assert torch.equal(yaw_on_sphere(yaw_on_sphere(values, grid, 2), grid, -2), values)
    both = yaw_on_sphere(values.expand(2, *grid.shape), grid, torch.tensor([1, 3]))
    assert torch.equal(both[1], yaw_on_sphere(values, grid, 3))
    normals = grid.directions.movedim(-1, 0)
    torch.testing.assert_close(yaw_on_sphere(normals, grid, 1, "normals"), normals, rtol=0, atol=1e-12)


def sample_of(grid: SphereGrid, batch: int, generator: torch.Generator) -> dict[str, Any]:
    rig = ring_rig(3, radius=0.2)
    return {
        "image": torch.rand(batch, 3, *grid.shape, generator=generator),
        "depth": 1 + torch.rand(batch, *grid.shape, generator=generator),
        "normals": grid.directions.movedim(-1, 0).float().expand(batch, 3, *grid.shape).clone(),
        "labels": torch.randint(0, 5, (batch, *grid.shape), generator=generator),
        "valid": torch.rand(batch, *grid.shape, generator=generator) > 0.5,
        "rig": type(rig).stack([rig] * batch),
        "frame": ["a", "b"],
    }


def assert_equal(one: dict[str, Any], other: dict[str, Any], atol: float = 0.0) -> None:
    assert one.keys() == other.keys()
    for key, value in one.items():
        if key == "rig":
            torch.testing.assert_close(
                value.world_from_camera, other[key].world_from_camera, rtol=0, atol=1e-6
            )
        elif isinstance(value, Tensor):
            torch.testing.assert_close(value, other[key], rtol=0, atol=atol if key == "normals" else 0)
        else:
            assert value == other[key]


AUGMENTATIONS = [
    lambda g: RandomSphereRotation(Icosphere(2), generator=g),
    lambda g: RandomYaw(Icosphere(2), generator=g),
    lambda g: RandomYaw(Equirectangular(6, 12), generator=g),
    lambda g: RandomYaw(Equirectangular(6, 12), angles="any", generator=g),
]


@pytest.mark.parametrize("make", AUGMENTATIONS)
def test_parameters_can_be_replayed(make: Any, generator: torch.Generator) -> None:
    augment = make(generator)
    sample = sample_of(augment.grid, 2, generator)
    turned = augment(sample)
    params = augment._params
    assert not torch.equal(turned["image"], sample["image"])
    assert_equal(augment(sample, params=params), turned)
    assert_equal(make(generator)(sample, params=params), turned)
    image = augment(sample["image"], params=params)  # a tensor alone is an image
    assert torch.equal(image, turned["image"])


@pytest.mark.parametrize("make", AUGMENTATIONS[1:3])
def test_exact_turns_are_undone_exactly(make: Any, generator: torch.Generator) -> None:
    augment = make(generator)
    sample = sample_of(augment.grid, 2, generator)
    assert_equal(augment.inverse(augment(sample)), sample, atol=1e-6)


def test_rotations_are_undone_up_to_interpolation(generator: torch.Generator) -> None:
    grid = Icosphere(4)
    augment = RandomSphereRotation(grid, generator=generator)
    image = smooth(grid.directions).expand(2, 3, -1)
    rig = ring_rig(4)
    back = augment.inverse(augment({"image": image, "rig": rig}))
    assert (back["image"] - image).abs().max() < 0.02
    torch.testing.assert_close(
        back["rig"].world_from_camera, rig.world_from_camera.expand(2, 4, 4, 4), rtol=0, atol=1e-6
    )


def test_p_and_same_on_batch(generator: torch.Generator) -> None:
    grid = Icosphere(2)
    image = torch.rand(64, 3, 162, generator=generator)
    augment = RandomSphereRotation(grid, p=0.5, generator=generator)
    turned = augment({"image": image, "rig": ring_rig(2)})
    kept = (turned["image"] == image).all(-1).all(-1)
    assert torch.equal(kept, ~augment._params["batch_prob"])
    assert 16 < kept.sum() < 48
    poses = turned["rig"].world_from_camera
    assert torch.equal(poses[kept], ring_rig(2).world_from_camera.expand(int(kept.sum()), 2, 4, 4))
    assert torch.equal(RandomYaw(grid, p=0.0)(image), image)

    same = RandomSphereRotation(grid, same_on_batch=True, generator=generator)
    turned = same(image[:1].expand(4, 3, 162))
    assert torch.equal(turned[0], turned[3])
    assert same._params["rotation"].shape == (1, 3, 3)


def test_a_single_sample_needs_no_batch_dimension(generator: torch.Generator) -> None:
    """With one rotation for all, images (n, 3, V) of cameras and depth (V,) turn alike, and the rig stays one rig."""
    grid = Icosphere(2)
    augment = RandomSphereRotation(grid, same_on_batch=True, generator=generator)
    images, depth = torch.rand(4, 3, 162, generator=generator), torch.rand(162, generator=generator)
    turned = augment({"images": images, "inverse_depth": depth, "rig": ring_rig(4)})
    turn = augment._params["rotation"][0]
    torch.testing.assert_close(turned["images"], rotate_on_sphere(images, grid, turn))
    assert torch.equal(turned["inverse_depth"], rotate_on_sphere(depth, grid, turn, "depth"))
    torch.testing.assert_close(
        turned["rig"].world_from_camera, ring_rig(4).rotated(rotation=turn).world_from_camera
    )


def test_images_of_cameras_stay(generator: torch.Generator) -> None:
    """Before ToSphere: the cameras turn with the world and see what they saw."""
    images = {"cam1": torch.rand(3, 8, 8), "cam2": torch.rand(3, 8, 8)}
    grid = Equirectangular(4, 8)
    sample = {"images": images, "inverse_depth": torch.rand(4, 8), "rig": ring_rig(2)}
    turned = RandomYaw(grid, same_on_batch=True, generator=generator)(sample)
    assert turned["images"] is images


def test_rotations_are_even_over_all(generator: torch.Generator) -> None:
    """Of Haar's measure: a turned vector is even over the sphere, and the trace has mean 0 and variance 1."""
    turns = random_rotations(20_000, generator=generator)
    trace = turns.diagonal(dim1=1, dim2=2).sum(1)
    assert trace.mean().abs() < 0.03
    assert abs(trace.var().item() - 1) < 0.05
    moments = (turns[:, :, 0, None] * turns[:, None, :, 0]).mean(0)
    torch.testing.assert_close(moments, torch.eye(3) / 3, rtol=0, atol=0.01)
    torch.testing.assert_close(torch.linalg.det(turns), torch.ones(len(turns)))


def test_a_generator_draws_the_turns_that_it_drew(generator: torch.Generator) -> None:
    turn = RandomSphereRotation(Icosphere(1), max_angle=0.7, generator=generator)
    drawn = [turn.generate_parameters((5,))["rotation"]]
    for angles in ("any", "grid"):
        drawn += RandomYaw(Icosphere(1), angles=angles, generator=generator).forward_parameters((4,)).values()
    assert weighted_sum(*drawn) == pytest.approx(9.16838, abs=1e-4)


def test_small_rotations_stay_below_the_largest_angle(generator: torch.Generator) -> None:
    turns = random_rotations(4000, 0.2, generator).double()
    sine = (turns - turns.mT).norm(dim=(1, 2)) / math.sqrt(8)
    angle = sine.asin()
    assert angle.max() <= 0.2 + 1e-6
    # The density grows with the square of the angle
    assert angle.mean().item() == pytest.approx(0.15, rel=0.02)
