# SPDX-License-Identifier: Apache-2.0
"""A camera model as a function of one vector of numbers, and the choices that a fit of it leaves open."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.base import Camera, Projection
from sphericalvision.geometry import angle_from_axis

__all__ = ["FOCAL", "FitChoices", "FittedModel", "Samples", "fit_choices", "fitted", "fitted_classes"]

FOCAL: dict[str, int | None] = {"focal_length": 2, "principal_point": 2}
"""The first ``sizes`` of most models."""


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
    def angle(self) -> Float[Tensor, " n"]:
        """Angles from the axis (n,)."""
        return angle_from_axis(self.directions)

    @property
    def radius(self) -> Float[Tensor, " n"]:
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

    def intrinsics(self, vector: Float[Tensor, "*batch p"]) -> dict[str, Tensor]:
        """The parts by name of one vector or of many, (*, p)."""
        parts = vector.split([size or 1 for size in self.sizes.values()], dim=-1)
        return {
            name: part[..., 0] if size is None else part
            for (name, size), part in zip(self.sizes.items(), parts, strict=True)
        }

    def vector(self, intrinsics: dict[str, Tensor]) -> Float[Tensor, " p"]:
        """The intrinsics, one after the other."""
        return torch.cat([intrinsics[name].reshape(-1) for name in self.sizes])

    def pixels(self, vector: Float[Tensor, "*vectors p"], directions: Float[Tensor, "n 3"]) -> Projection:
        """Pixels (n, 2) of directions (n, 3)."""
        return self.project(directions, *self.intrinsics(vector).values())

    @torch.enable_grad()
    def jacobian(
        self, vector: Float[Tensor, " p"], directions: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n 2 p"]:
        """Derivatives (n, 2, p) of the pixels; a copy of the vector for each direction makes it two backward passes."""
        copies = vector.expand(len(directions), -1).clone().requires_grad_()
        u, v = self.pixels(copies, directions).pixels.unbind(-1)
        (grad_u,) = torch.autograd.grad(u.sum(), copies, retain_graph=True)
        (grad_v,) = torch.autograd.grad(v.sum(), copies)
        return torch.stack((grad_u, grad_v), dim=1)

    def limits(self, like: Float[Tensor, " ..."]) -> tuple[Float[Tensor, " p"], Float[Tensor, " p"]]:
        """Smallest and largest values of the vector."""
        open_ended = (-math.inf, math.inf)
        ends = [[self.bounds.get(name, open_ended)] * (size or 1) for name, size in self.sizes.items()]
        table = like.new_tensor(list(itertools.chain.from_iterable(ends)))
        return table[:, 0], table[:, 1]

    def own_start(self, camera: Camera) -> list[Float[Tensor, " p"]]:
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

    def build(
        self, vector: Float[Tensor, " p"], image_size: tuple[int, int], max_angle: float, like: Camera
    ) -> Camera:
        """The camera of a vector, in the dtype and on the device of ``like``."""
        vector = vector.to(like.device, like.dtype)
        intrinsics: dict[str, Any] = self.intrinsics(vector) | self.constants
        if self.complete is not None:
            intrinsics = self.complete(intrinsics)
        return self.camera_class(**intrinsics, image_size=image_size, max_angle=max_angle)


class FitChoices(NamedTuple):
    """How a model is fitted, with the options that it leaves open."""

    make: Callable[[int, str], FittedModel]
    """From a number of coefficients and a projection, of which most models heed none."""
    num_coefficients: tuple[int, ...] = ()
    """Allowed numbers of coefficients, the default first."""
    projections: tuple[str, ...] = ()
    """Allowed projections, of which the best is the default."""


_CHOICES: dict[type[Camera], FitChoices] = {}


def fitted(
    camera_class: type[Camera], num_coefficients: tuple[int, ...] = (), projections: tuple[str, ...] = ()
) -> Callable[[Callable[[int, str], FittedModel]], Callable[[int, str], FittedModel]]:
    """Decorate the function that makes the ``FittedModel`` of a camera class: ``convert`` then converts to it."""

    def register(make: Callable[[int, str], FittedModel]) -> Callable[[int, str], FittedModel]:
        _CHOICES[camera_class] = FitChoices(make, num_coefficients, projections)
        return make

    return register


def fit_choices(camera_class: type[Camera]) -> FitChoices | None:
    """How a camera class is fitted, or None if it says nothing of it."""
    return _CHOICES.get(camera_class)


def fitted_classes() -> list[type[Camera]]:
    """All camera classes that say how they are fitted."""
    return list(_CHOICES)
