# SPDX-License-Identifier: Apache-2.0
"""Pure functions: directions, rigid transforms, interpolation and root finding."""

from sphericalvision.geometry.directions import (
    angle_from_axis,
    angle_over_radius,
    cosine_and_sinc,
    directions_from_longitude_latitude,
    longitude_latitude_from_directions,
    normalize,
    safe_hypot,
    safe_sqrt,
)
from sphericalvision.geometry.interpolation import bilinear_sample
from sphericalvision.geometry.rootfinding import Root, increasing_limit, polynomial, solve_increasing
from sphericalvision.geometry.transforms import (
    axis_angle_from_transform,
    invert_transform,
    transform_from_axis_angle,
    transform_from_quaternion,
    transform_points,
)

__all__ = [
    "Root",
    "angle_from_axis",
    "angle_over_radius",
    "axis_angle_from_transform",
    "bilinear_sample",
    "cosine_and_sinc",
    "directions_from_longitude_latitude",
    "increasing_limit",
    "invert_transform",
    "longitude_latitude_from_directions",
    "normalize",
    "polynomial",
    "safe_hypot",
    "safe_sqrt",
    "solve_increasing",
    "transform_from_axis_angle",
    "transform_from_quaternion",
    "transform_points",
]
