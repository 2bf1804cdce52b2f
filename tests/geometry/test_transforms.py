# SPDX-License-Identifier: Apache-2.0
"""Rigid transforms, against OpenCV's Rodrigues, matrix inversion and scipy-free quaternion algebra."""

import math

import cv2
import numpy as np
import pytest
import torch

from sphericalvision.geometry import (
    invert_transform,
    transform_from_axis_angle,
    transform_from_quaternion,
    transform_points,
)
from sphericalvision.geometry.transforms import axis_angle_from_transform


def random_transforms(generator: torch.Generator, *shape: int) -> torch.Tensor:
    axis_angle = torch.randn(*shape, 3, generator=generator, dtype=torch.float64)
    return transform_from_axis_angle(
        axis_angle, torch.randn(*shape, 3, generator=generator, dtype=torch.float64)
    )


def test_convention_a_from_b() -> None:
    """``world_from_camera`` takes camera coordinates to the world's: the camera stands at its last column."""
    world_from_camera = transform_from_axis_angle(
        torch.tensor([0.0, math.pi / 2, 0.0]), torch.tensor([1.0, 2.0, 3.0])
    )
    in_camera = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]])
    in_world = transform_points(world_from_camera, in_camera)
    torch.testing.assert_close(in_world, torch.tensor([[1.0, 2.0, 3.0], [3.0, 2.0, 3.0]]))
    torch.testing.assert_close(transform_points(invert_transform(world_from_camera), in_world), in_camera)


@pytest.mark.parametrize("length", [0.0, 1e-9, 1e-4, 1e-3, 0.5, 3.1, math.pi])
def test_rotation_vector_against_opencv(length: float) -> None:
    vector = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8]) * length
    ours = transform_from_axis_angle(torch.tensor(vector), torch.zeros(3, dtype=torch.float64))[:3, :3]
    np.testing.assert_allclose(ours, cv2.Rodrigues(vector)[0], atol=1e-14)


def test_rotation_vector_survives_the_round_trip(generator: torch.Generator) -> None:
    transforms = random_transforms(generator, 4, 5)
    axis_angle, translation = axis_angle_from_transform(transforms)
    torch.testing.assert_close(transform_from_axis_angle(axis_angle, translation), transforms)


@pytest.mark.parametrize("vector", [(0.0, 0.0, 0.0), (0.0, 0.0, 1e-4), (3.0, 0.0, 0.0), (0.1, -0.2, 0.3)])
def test_rotation_vector_and_matrix_have_gradients_everywhere(vector: tuple[float, ...]) -> None:
    """Those there and back again are one, at no turn and about a single axis as well."""
    axis_angle = torch.tensor(vector, dtype=torch.float64)

    def there_and_back(vector: torch.Tensor) -> torch.Tensor:
        return axis_angle_from_transform(transform_from_axis_angle(vector, torch.zeros(3).double()))[0]

    slopes = torch.autograd.functional.jacobian(there_and_back, axis_angle)
    torch.testing.assert_close(slopes, torch.eye(3).double(), atol=1e-6, rtol=0)


def test_inverse_is_the_matrix_inverse(generator: torch.Generator) -> None:
    transforms = random_transforms(generator, 2, 3)
    torch.testing.assert_close(invert_transform(transforms), torch.linalg.inv(transforms))


def test_one_point_by_many_poses(generator: torch.Generator) -> None:
    poses, point = (
        random_transforms(generator, 2, 4),
        torch.randn(3, generator=generator, dtype=torch.float64),
    )
    torch.testing.assert_close(
        transform_points(poses, point), transform_points(poses, point[None])[..., 0, :]
    )
    assert transform_points(poses[0, 0], point).shape == (3,)


def test_points_against_homogeneous_coordinates(generator: torch.Generator) -> None:
    transforms = random_transforms(generator, 4)
    points = torch.randn(4, 7, 3, generator=generator, dtype=torch.float64)
    homogeneous = torch.cat((points, torch.ones(4, 7, 1, dtype=torch.float64)), -1)
    expected = (transforms[:, None] @ homogeneous[..., None])[..., :3, 0]
    torch.testing.assert_close(transform_points(transforms, points), expected)


def test_quaternion_is_w_first_and_equals_the_rotation_vector() -> None:
    half = torch.tensor(0.35, dtype=torch.float64)
    axis = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    quaternion = torch.cat((half.cos()[None], half.sin() * axis))
    shift = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    expected = transform_from_axis_angle(2 * half * axis, shift)
    torch.testing.assert_close(transform_from_quaternion(2.5 * quaternion, shift), expected)
