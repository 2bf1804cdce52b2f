# SPDX-License-Identifier: Apache-2.0
"""Least squares fits of a camera model to the directions and pixels of another camera."""

from __future__ import annotations

import math
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.field_of_view import cap, focal_length_on_axis
from sphericalvision.cameras.fitting import FittedModel, Samples
from sphericalvision.cameras.model_alone import project_by_model
from sphericalvision.core import ArgumentError
from sphericalvision.geometry import angle_from_axis
from sphericalvision.geometry.least_squares import solve_least_squares

ROUNDS = 6
"""Fits over a field of view that is narrowed to what the model reaches."""

_FITTED = 600  # directions in the cap of the field of view; fewer are on the image
_GOOD_ENOUGH = 1e-9  # pixels


class Fit(NamedTuple):
    """A model fitted to a camera."""

    model: FittedModel
    vector: Tensor
    covered_angle: float
    rms: float


def fit_model(camera: Camera, model: FittedModel, held_out: Float[Tensor, "n 3"], limit: float) -> Fit:
    """The best fit within ``limit``; the field of view shrinks to what the model reaches of ``held_out`` directions."""
    best: Tensor | None = None
    for _ in range(ROUNDS):
        samples = _samples(camera, limit, model)
        starts = [*model.own_start(camera), *model.choices.starts(model, samples)] if best is None else [best]
        low, high = model.limits(samples.pixels)

        def residuals(vector: Tensor, samples: Samples = samples) -> Tensor:
            return (model.pixels(vector, samples.directions).pixels - samples.pixels).flatten()

        def jacobian(vector: Tensor, samples: Samples = samples) -> Tensor:
            return model.jacobian(vector, samples.directions).flatten(0, 1)

        least = math.inf
        for start in starts:
            solution, rms = solve_least_squares(residuals, start, jacobian, low, high)
            if rms < least:
                best, least = solution, rms
            if least < _GOOD_ENOUGH:
                break
        if best is None or not math.isfinite(least):
            break
        angle = angle_from_axis(held_out)
        lost = angle[~model.pixels(best, held_out).valid & (angle <= limit)]
        if not len(lost):
            return Fit(model, best, limit, least)
        limit = float(lost.min()) * (1 - 1e-3)
    raise cannot_show(camera, model.choices.camera_class)


def cannot_show(camera: Camera, model: type[Camera]) -> ArgumentError:
    """The error of a model that reaches nothing of a camera's view."""
    return ArgumentError(
        f"camera: a {model.__name__} cannot show what this {camera!r} sees; choose another model or, for "
        "the part around the axis, a smaller max_angle"
    )


def _samples(camera: Camera, limit: float, model: FittedModel) -> Samples:
    """Directions that the camera sees within ``limit``, evenly over the sphere, and their pixels."""
    for count in (_FITTED, 16 * _FITTED):
        directions = cap(limit, count, camera)
        pixels, valid = camera.project(directions)
        if valid.sum() >= _FITTED // 4:
            break
    if valid.sum() < 64:
        raise ArgumentError(
            f"camera: nothing is left to fit: this {camera!r} sees {int(valid.sum())} of {count} directions within "
            f"{math.degrees(limit):.1f}° of its axis, where a {model.choices.camera_class.__name__} could show them"
        )
    focal_length = focal_length_on_axis(camera)
    center = project_by_model(camera, directions.new_tensor([0.0, 0.0, 1.0])).pixels
    if not bool((focal_length > 0).all() & center.isfinite().all()):
        height, width = camera.image_size
        center = directions.new_tensor([(width - 1) / 2, (height - 1) / 2])
        radius = (pixels - center).norm(dim=-1)[valid] / angle_from_axis(directions[valid])
        focal_length = radius.median().expand(2)
    return Samples(directions[valid], pixels[valid], center, focal_length)
