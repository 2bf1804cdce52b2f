# SPDX-License-Identifier: Apache-2.0
"""Least squares fits of a camera model to the directions and pixels of another camera."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

from sphericalvision.cameras.base import Camera, Projection
from sphericalvision.cameras.field_of_view import directions_around_axis, focal_length_on_axis
from sphericalvision.core import ArgumentError
from sphericalvision.geometry import angle_from_axis, solve_least_squares

__all__ = ["ROUNDS", "Fit", "FittedModel", "Samples", "cap", "fit_model"]

ROUNDS = 6
"""Fits over a field of view that is narrowed to what the model reaches."""

_FITTED = 600  # directions in the cap of the field of view; fewer are on the image
_GOOD_ENOUGH = 1e-9  # pixels


class Samples(NamedTuple):
    """Where a camera images directions, and how it does so around its axis."""

    directions: Tensor
    """(n, 3)."""
    pixels: Tensor
    """(n, 2)."""
    center: Tensor
    """Pixel of the axis (2,)."""
    focal_length: Tensor
    """Pixels per radian at the axis (2,)."""

    @property
    def angle(self) -> Tensor:
        """Angles from the axis (n,)."""
        return angle_from_axis(self.directions)

    @property
    def radius(self) -> Tensor:
        """Image radii (n,) in focal lengths."""
        return ((self.pixels - self.center) / self.focal_length).norm(dim=-1)


@dataclass(frozen=True)
class FittedModel:
    """A camera model as a function of one vector: the intrinsics, one after the other, in float64.

    Attributes:
        camera_class: that the vector becomes.
        project: the model's function.
        sizes: name -> how many numbers, ``None`` for one without a dimension of its own; in the function's order.
        starts: vectors to start from, made from samples.
        bounds: name -> (smallest, largest).
        reach: the widest angle from the axis that is tried, in radians.
        constants: constructor arguments that are not fitted.
        complete: adds those that follow from fitted ones.
    """

    camera_class: type[Camera]
    project: Callable[..., Projection]
    sizes: dict[str, int | None]
    starts: Callable[[FittedModel, Samples], Iterable[Tensor]]
    bounds: dict[str, tuple[float, float]] = field(default_factory=dict)
    reach: float = math.pi
    constants: dict[str, Any] = field(default_factory=dict)
    complete: Callable[[dict[str, Any]], dict[str, Any]] | None = None

    def intrinsics(self, vector: Tensor) -> dict[str, Tensor]:
        """The parts by name of one vector or of many, (*, p)."""
        parts = vector.split([size or 1 for size in self.sizes.values()], dim=-1)
        return {
            name: part[..., 0] if size is None else part
            for (name, size), part in zip(self.sizes.items(), parts, strict=True)
        }

    def vector(self, intrinsics: dict[str, Tensor]) -> Tensor:
        """The intrinsics, one after the other."""
        return torch.cat([intrinsics[name].reshape(-1) for name in self.sizes])

    def pixels(self, vector: Tensor, directions: Tensor) -> Projection:
        """Pixels (n, 2) of directions (n, 3)."""
        return self.project(directions, *self.intrinsics(vector).values())

    @torch.enable_grad()
    def jacobian(self, vector: Tensor, directions: Tensor) -> Tensor:
        """Derivatives (n, 2, p) of the pixels; a copy of the vector for each direction makes it two backward passes."""
        copies = vector.expand(len(directions), -1).clone().requires_grad_()
        u, v = self.pixels(copies, directions).pixels.unbind(-1)
        (of_u,) = torch.autograd.grad(u.sum(), copies, retain_graph=True)
        (of_v,) = torch.autograd.grad(v.sum(), copies)
        return torch.stack((of_u, of_v), dim=1)

    def limits(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """Smallest and largest values of the vector."""
        open_ended = (-math.inf, math.inf)
        ends = [[self.bounds.get(name, open_ended)] * (size or 1) for name, size in self.sizes.items()]
        table = like.new_tensor(list(itertools.chain.from_iterable(ends)))
        return table[:, 0], table[:, 1]

    def own_start(self, camera: Camera) -> list[Tensor]:
        """The camera's own intrinsics, if it is of this model with as many numbers."""
        if type(camera) is not self.camera_class:
            return []
        if any(getattr(camera, key) != value for key, value in self.constants.items()):
            return []
        values = {name: getattr(camera, name) for name in self.sizes}
        if "focal_length" in values:
            values["focal_length"] = values["focal_length"].expand(2)
        if any(v is None or v.numel() != (self.sizes[n] or 1) for n, v in values.items()):
            return []
        return [self.vector(values).double()]

    def build(self, vector: Tensor, image_size: tuple[int, int], max_angle: float, like: Camera) -> Camera:
        """The camera of a vector, in the dtype and on the device of ``like``."""
        vector = vector.to(like.device, like.dtype)
        intrinsics: dict[str, Any] = self.intrinsics(vector) | self.constants
        if self.complete is not None:
            intrinsics = self.complete(intrinsics)
        return self.camera_class(**intrinsics, image_size=image_size, max_angle=max_angle)


class Fit(NamedTuple):
    """A model fitted to a camera."""

    model: FittedModel
    vector: Tensor
    covered_angle: float
    rms: float


def fit_model(camera: Camera, model: FittedModel, held_out: Tensor, limit: float) -> Fit:
    """The best fit within ``limit``; the field of view shrinks to what the model reaches of ``held_out`` directions.

    Raises:
        ArgumentError: nothing is left.
    """
    best: Tensor | None = None
    for _ in range(ROUNDS):
        samples = _samples(camera, limit, model)
        starts = [*model.own_start(camera), *model.starts(model, samples)] if best is None else [best]
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
    raise ArgumentError(
        f"camera: a {model.camera_class.__name__} cannot show what this {camera!r} sees; choose another model or, for "
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
            f"{math.degrees(limit):.1f}° of its axis, where a {model.camera_class.__name__} could show them"
        )
    focal_length = focal_length_on_axis(camera)
    center = camera._project(directions.new_tensor([0.0, 0.0, 1.0])).pixels
    if not bool((focal_length > 0).all() & center.isfinite().all()):
        height, width = camera.image_size
        center = directions.new_tensor([(width - 1) / 2, (height - 1) / 2])
        radius = (pixels - center).norm(dim=-1)[valid] / angle_from_axis(directions[valid])
        focal_length = radius.median().expand(2)
    return Samples(directions[valid], pixels[valid], center, focal_length)


def cap(limit: float, count: int, like: Camera) -> Tensor:
    """Directions (count, 3) within ``limit`` of the axis, on a spiral of equal areas."""
    step = torch.arange(count, dtype=torch.float64, device=like.device)
    angle = 2 * torch.asin(math.sin(limit / 2) * ((step + 0.5) / count).sqrt())
    return directions_around_axis(angle, step * (math.pi * (3 - math.sqrt(5))))
