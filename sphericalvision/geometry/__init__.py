# SPDX-License-Identifier: Apache-2.0
"""Pure functions: directions, rigid transforms and interpolation.

Numerics that cameras and grids are made of are in the modules: ``directions``, ``rootfinding``, ``inverse_table``,
``least_squares``.
"""

from sphericalvision.geometry.directions import (
    angle_from_axis,
    directions_from_longitude_latitude,
    longitude_latitude_from_directions,
    normalize,
)
from sphericalvision.geometry.interpolation import bilinear_sample
from sphericalvision.geometry.transforms import (
    invert_transform,
    transform_from_axis_angle,
    transform_from_quaternion,
    transform_points,
)

__all__ = [
    "angle_from_axis",
    "bilinear_sample",
    "directions_from_longitude_latitude",
    "invert_transform",
    "longitude_latitude_from_directions",
    "normalize",
    "transform_from_axis_angle",
    "transform_from_quaternion",
    "transform_points",
]
