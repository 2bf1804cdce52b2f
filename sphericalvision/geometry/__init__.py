# SPDX-License-Identifier: Apache-2.0
"""Pure functions: directions, rigid transforms, interpolation and root finding."""

from sphericalvision.geometry.directions import (
    angle_from_axis,
    angle_over_radius,
    components,
    cosine_and_lifted_sinc,
    cosine_and_sinc,
    directions_from_longitude_latitude,
    from_components,
    is_at_least,
    is_greater,
    lifted_radius,
    longitude_latitude_from_directions,
    normalize,
    safe_hypot,
    safe_sqrt,
)
from sphericalvision.geometry.interpolation import bilinear_sample, wrap_panorama
from sphericalvision.geometry.inverse_table import InverseTable, samples_towards, tabulate_inverse
from sphericalvision.geometry.least_squares import LeastSquares, solve_least_squares
from sphericalvision.geometry.rootfinding import (
    Root,
    increasing_limit,
    polynomial,
    polynomial_value,
    polynomial_with_curvature,
    refine_root,
    solve_increasing,
)
from sphericalvision.geometry.transforms import (
    axis_angle_from_transform,
    invert_transform,
    transform_from_axis_angle,
    transform_from_quaternion,
    transform_points,
)

__all__ = [
    "InverseTable",
    "LeastSquares",
    "Root",
    "angle_from_axis",
    "angle_over_radius",
    "axis_angle_from_transform",
    "bilinear_sample",
    "components",
    "cosine_and_lifted_sinc",
    "cosine_and_sinc",
    "directions_from_longitude_latitude",
    "from_components",
    "increasing_limit",
    "invert_transform",
    "is_at_least",
    "is_greater",
    "lifted_radius",
    "longitude_latitude_from_directions",
    "normalize",
    "polynomial",
    "polynomial_value",
    "polynomial_with_curvature",
    "refine_root",
    "safe_hypot",
    "safe_sqrt",
    "samples_towards",
    "solve_increasing",
    "solve_least_squares",
    "tabulate_inverse",
    "transform_from_axis_angle",
    "transform_from_quaternion",
    "transform_points",
    "wrap_panorama",
]
