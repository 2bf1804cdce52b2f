# SPDX-License-Identifier: Apache-2.0
"""Directions and angles, against numpy in float64 and against finite differences."""

import math

import pytest
import torch

from sphericalvision.geometry import (
    angle_from_axis,
    directions_from_longitude_latitude,
    longitude_latitude_from_directions,
    normalize,
)
from sphericalvision.geometry.directions import safe_hypot, safe_sqrt


def test_convention_axes() -> None:
    """x right, y down, z forward; longitude grows to the right, latitude upwards."""
    longitude = torch.tensor([0.0, math.pi / 2, 0.0], dtype=torch.float64)
    latitude = torch.tensor([0.0, 0.0, math.pi / 2], dtype=torch.float64)
    forward, right, up = directions_from_longitude_latitude(longitude, latitude)
    torch.testing.assert_close(forward, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    torch.testing.assert_close(right, torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))
    torch.testing.assert_close(up, torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64))


def test_convention_angle_from_axis_is_atan2() -> None:
    """Small angles keep their digits in float32, where acos of the cosine would return 0."""
    angles = torch.tensor([1e-12, 1e-7, 1e-4, 1e-2, 1.0, 3.0])
    points = torch.stack((angles.sin(), torch.zeros(6), angles.cos()), -1)
    torch.testing.assert_close(angle_from_axis(points), angles, rtol=1e-6, atol=0)
    assert torch.acos(points[1, 2]) == 0
    on_axis = torch.tensor([0.0, 0.0, 1.0], requires_grad=True)
    (gradient,) = torch.autograd.grad(angle_from_axis(on_axis), on_axis)
    assert torch.isfinite(gradient).all()


def test_convention_angles_in_radians() -> None:
    assert angle_from_axis(torch.tensor([0.0, 2.0, 0.0])).item() == pytest.approx(math.pi / 2)
    longitude, _ = longitude_latitude_from_directions(torch.tensor([1.0, 0.0, 0.0]))
    assert longitude.item() == pytest.approx(math.pi / 2)


def test_longitude_and_latitude_survive_the_round_trip(generator: torch.Generator) -> None:
    directions = normalize(torch.randn(500, 3, generator=generator, dtype=torch.float64))
    again = directions_from_longitude_latitude(*longitude_latitude_from_directions(3 * directions))
    torch.testing.assert_close(again, directions)


def test_poles_have_longitude_zero_and_finite_gradients() -> None:
    poles = torch.tensor([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0], [1e-25, -1.0, 0.0]], requires_grad=True)
    longitude, latitude = longitude_latitude_from_directions(poles)
    assert longitude[:2].tolist() == [0, 0]
    torch.testing.assert_close(latitude, torch.tensor([math.pi / 2, -math.pi / 2, math.pi / 2]))
    (gradient,) = torch.autograd.grad((longitude + latitude).sum(), poles)
    assert gradient.abs().max() <= 1


def test_safe_functions_have_finite_gradients_at_zero() -> None:
    zero = torch.zeros(3, requires_grad=True)
    for value in (safe_sqrt(zero), safe_hypot(zero, zero), normalize(zero)):
        (gradient,) = torch.autograd.grad(value.sum(), zero)
        assert value.tolist() == [0, 0, 0]
        assert torch.isfinite(gradient).all()
