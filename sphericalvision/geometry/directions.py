# SPDX-License-Identifier: Apache-2.0
"""Directions on the unit sphere and angles whose derivatives stay finite everywhere.

Convention:
    x right, y down, z forward. Longitude 0 is forward (+z) and grows to the right (+x is +π/2);
    latitude is +π/2 straight up, which is (0, −1, 0).
"""

from __future__ import annotations

import torch
from torch import Tensor

from sphericalvision.core import check_last_dim

__all__ = [
    "angle_from_axis",
    "angle_over_radius",
    "cosine_and_sinc",
    "directions_from_longitude_latitude",
    "longitude_latitude_from_directions",
    "normalize",
    "safe_hypot",
    "safe_sqrt",
]


def safe_sqrt(x: Tensor) -> Tensor:
    """Square root of ``x`` (*), with value and derivative 0 where ``x`` is not positive.

    Examples:
        >>> safe_sqrt(torch.tensor([4.0, 0.0, -1.0])).tolist()
        [2.0, 0.0, 0.0]
    """
    positive = x > torch.finfo(x.dtype).tiny
    return torch.where(positive, torch.sqrt(torch.where(positive, x, 1.0)), 0.0)


def safe_hypot(x: Tensor, y: Tensor) -> Tensor:
    """Length of (x, y), shape (*), with derivative 0 instead of NaN at the origin.

    Examples:
        >>> safe_hypot(torch.tensor(3.0), torch.tensor(4.0)).item()
        5.0
    """
    origin = (x == 0) & (y == 0)
    return torch.where(origin, 0.0, torch.hypot(torch.where(origin, 1.0, x), y))


def normalize(vectors: Tensor) -> Tensor:
    """Scale ``vectors`` (*, 3) to unit length; a zero vector stays zero.

    Examples:
        >>> normalize(torch.tensor([0.0, 0.0, 2.0])).tolist()
        [0.0, 0.0, 1.0]
    """
    check_last_dim("vectors", vectors, 3)
    largest = vectors.detach().abs().amax(dim=-1, keepdim=True)  # so that squares neither overflow nor vanish
    scaled = vectors / torch.where(largest > 0, largest, 1.0)
    return torch.nn.functional.normalize(scaled, dim=-1)


def angle_from_axis(points: Tensor) -> Tensor:
    """Angle in radians between ``points`` (*, 3) and the optical axis +z, in [0, π], shape (*).

    ``atan2`` keeps small angles exact in float32, where ``acos`` would lose them.

    Examples:
        >>> angle_from_axis(torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])).tolist()
        [0.0, 1.5707963705062866]
    """
    check_last_dim("points", points, 3)
    x, y, z = points.unbind(-1)
    return torch.atan2(safe_hypot(x, y), z)


def angle_over_radius(points: Tensor) -> Tensor:
    """Angle from the axis divided by ``hypot(x, y)`` for ``points`` (*, 3), shape (*).

    The quotient is smooth on the forward axis (there it is 1/z), so a lens model written with it has exact
    first and second derivatives there. On the backward axis, where no limit exists, it is 0.

    Examples:
        >>> angle_over_radius(torch.tensor([0.0, 0.0, 4.0])).item()
        0.25
    """
    x, y, z = points.unbind(-1)
    squared = x * x + y * y
    near = (z > 0) & (squared < torch.finfo(points.dtype).eps ** (1 / 3) * z * z)
    forward = torch.where(near, z, 1.0)
    q = torch.where(near, squared, 0.0) / (forward * forward)
    series = (1 - q / 3 + q * q / 5 - q * q * q / 7) / forward
    regular = ~near & (squared > torch.finfo(points.dtype).tiny)
    radius = torch.sqrt(torch.where(regular, squared, 1.0))
    quotient = torch.atan2(radius, torch.where(regular, z, 0.0)) / radius
    return torch.where(near, series, torch.where(regular, quotient, 0.0))


def cosine_and_sinc(angle_squared: Tensor) -> tuple[Tensor, Tensor]:
    """``cos(a)`` and ``sin(a)/a`` from the squared angle (*) in rad², smooth at zero.

    Examples:
        >>> [value.item() for value in cosine_and_sinc(torch.tensor(0.0))]
        [1.0, 1.0]
    """
    near = angle_squared < torch.finfo(angle_squared.dtype).eps ** (1 / 4)
    small = torch.where(near, angle_squared, 0.0)
    cosine_series = 1 - small / 2 * (1 - small / 12 * (1 - small / 30 * (1 - small / 56)))
    sinc_series = 1 - small / 6 * (1 - small / 20 * (1 - small / 42 * (1 - small / 72)))
    angle = torch.sqrt(torch.where(near, 1.0, angle_squared))
    return (
        torch.where(near, cosine_series, torch.cos(angle)),
        torch.where(near, sinc_series, torch.sin(angle) / angle),
    )


def directions_from_longitude_latitude(longitude: Tensor, latitude: Tensor) -> Tensor:
    """Unit directions (*, 3) from longitude and latitude (*) in radians.

    Examples:
        >>> quarter = torch.tensor(torch.pi / 2)
        >>> directions_from_longitude_latitude(quarter, torch.tensor(0.0))[0].item()  # to the right is +x
        1.0
        >>> directions_from_longitude_latitude(torch.tensor(0.0), quarter)[1].item()  # up is -y
        -1.0
    """
    longitude, latitude = torch.broadcast_tensors(longitude, latitude)
    flat = torch.cos(latitude)
    return torch.stack(
        (flat * torch.sin(longitude), -torch.sin(latitude), flat * torch.cos(longitude)), dim=-1
    )


def longitude_latitude_from_directions(directions: Tensor) -> tuple[Tensor, Tensor]:
    """Longitude in [−π, π] and latitude in [−π/2, π/2] (*), radians, of ``directions`` (*, 3) of any length.

    At a pole the longitude is 0 and its derivative, which has no limit there, is 0 too.

    Examples:
        >>> longitude, latitude = longitude_latitude_from_directions(torch.tensor([0.0, 0.0, 1.0]))
        >>> longitude.item(), latitude.item() == 0
        (0.0, True)
    """
    check_last_dim("directions", directions, 3)
    x, y, z = directions.unbind(-1)
    pole = (x == 0) & (z == 0)
    longitude = torch.atan2(x, torch.where(pole, 1.0, z))
    return longitude, torch.atan2(-y, safe_hypot(x, z))
