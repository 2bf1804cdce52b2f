# SPDX-License-Identifier: Apache-2.0
"""A camera from pictures of a known object alone, whatever its model: no calibration to start from."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.conversion.convert import convert
from sphericalvision.cameras.field_of_view import field_of_view as view_of
from sphericalvision.cameras.models.fisheye import FisheyeCamera
from sphericalvision.cameras.models.kannala_brandt import KannalaBrandtCamera
from sphericalvision.capture.calibrating.refine import RefinedCamera, refine
from sphericalvision.core import ArgumentError

__all__ = ["calibrate_camera"]


def calibrate_camera(
    points: Float[Tensor, "m 3"],
    pixels: Float[Tensor, "n m 2"],
    image_size: Sequence[int],
    model: type[Camera] | str = KannalaBrandtCamera,
    seen: Bool[Tensor, "n m"] | None = None,
    *,
    field_of_view: float = math.pi,
    num_coefficients: int | None = None,
    projection: str | None = None,
) -> RefinedCamera:
    """The camera of a model that explains ``pixels`` (n, m, 2) of an object's ``points`` (m, 3) best.

    An ideal fisheye is refined, then a Kannala-Brandt lens that starts from it, and then the wanted model.
    Views should reach all parts of the image, and the object be tilted in some of them.

    Args:
        points: (m, 3) in the object's frame, metres; z = 0 for a board.
        pixels: (n, m, 2) as (u, v), where each point was found.
        image_size: (height, width).
        model: class of the camera, or its name in files.
        seen: (n, m), which were found; all by default.
        field_of_view: roughly that of the shorter side of the image, in radians; within a third of the truth is enough.
        num_coefficients: of the model, where it has a choice, as in ``convert``.
        projection: of ``FisheyeCamera``, as in ``convert``.

    Raises:
        ArgumentError: no view has enough points, or the model cannot show what is seen.
        ShapeError: the shapes do not fit.

    Examples:
        >>> from sphericalvision.geometry import transform_from_axis_angle, transform_points
        >>> truth = FisheyeCamera.from_field_of_view((240, 320), 2.6, "equisolid", torch.float64)
        >>> board = torch.cartesian_prod(torch.arange(7.0), torch.arange(5.0), torch.zeros(1)).double() * 0.05
        >>> turns = torch.tensor([[0.0, 0.9, 0.1], [0.8, 0.0, 0.0], [0.1, -0.9, 0.3], [-0.7, 0.2, 0]]).double()
        >>> places = torch.tensor([[0.1, -0.1, 0.2], [-0.2, 0.05, 0.2], [-0.5, 0.0, 0.2], [-0.1, -0.4, 0.2]]).double()
        >>> at = truth.project(transform_points(transform_from_axis_angle(turns, places), board))
        >>> found = calibrate_camera(board, at.pixels, (240, 320), FisheyeCamera, at.valid, projection="equisolid")
        >>> bool((found.camera.focal_length - truth.focal_length).abs().max() < 1e-4)
        True
    """
    if not 0 < field_of_view < 2 * math.pi:
        raise ArgumentError(f"field_of_view: expected radians in (0, 2π), got {field_of_view}")
    ideal = FisheyeCamera.from_field_of_view(image_size, field_of_view, dtype=torch.float64)
    camera: Camera = ideal.with_max_angle(math.pi)
    camera = refine(camera, points, pixels, seen, fixed=("principal_point",)).camera
    camera = convert(
        refine(camera, points, pixels, seen).camera, KannalaBrandtCamera, num_coefficients=2
    ).camera
    found = refine(camera, points, pixels, seen)
    camera = found.camera.with_max_angle(min(_reached(found), view_of(found.camera).widest))
    wanted = convert(camera, model, num_coefficients=num_coefficients, projection=projection).camera
    return refine(wanted, points, pixels, seen)


def _reached(found: RefinedCamera) -> float:
    """The largest angle from the axis at which the camera looks at all: the lens is not known beyond what was seen."""
    return min(math.pi, 1.05 * float(found.camera.max_angle))
