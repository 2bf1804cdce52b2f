# SPDX-License-Identifier: Apache-2.0
"""A camera model as a function of one vector of numbers, the choices that a fit leaves open, and where it starts."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.base import Camera, Projection
from sphericalvision.cameras.declaration import ANY, Choice, Intrinsic
from sphericalvision.geometry import angle_from_axis

PLANE_REACH = math.radians(80)
"""A model of the image plane is fitted up to here, unless the original ends before."""


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
        choices: of its class.
        project: the model's function.
        sizes: name -> how many numbers, ``None`` for one without a dimension of its own; in the function's order.
        constants: constructor arguments that are not fitted.
        reach: the widest angle from the axis that is tried, in radians.
    """

    choices: FitChoices
    project: Callable[..., Projection]
    sizes: Mapping[str, int | None]
    constants: Mapping[str, Any]
    reach: float

    def intrinsics(self, vector: Float[Tensor, "*batch p"]) -> dict[str, Tensor]:
        """The parts by name of one vector or of many, (*, p)."""
        vectors = vector.split([size or 1 for size in self.sizes.values()], dim=-1)
        return {
            name: part[..., 0] if size is None else part
            for (name, size), part in zip(self.sizes.items(), vectors, strict=True)
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
        bounds = self.choices.bounds
        ends = [[bounds.get(name, open_ended)] * (size or 1) for name, size in self.sizes.items()]
        table = like.new_tensor(list(itertools.chain.from_iterable(ends)))
        return table[:, 0], table[:, 1]

    def own_start(self, camera: Camera) -> list[Float[Tensor, " p"]]:
        """The camera's own intrinsics, if it is of this model with as many numbers."""
        if type(camera) is not self.choices.camera_class:
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
        intrinsics: dict[str, Any] = {**self.intrinsics(vector), **self.constants}
        if self.choices.complete is not None:
            intrinsics = self.choices.complete(intrinsics)
        return self.choices.camera_class(**intrinsics, image_size=image_size, max_angle=max_angle)


@dataclass(frozen=True)
class FitChoices:
    """How a model is fitted, with the options that it leaves open.

    Attributes:
        camera_class: the model.
        starts: vectors to start from, made from samples.
        num_coefficients: numbers of coefficients that are allowed, the default first.
        projections: projections that are allowed, of which the best is the default.
        bounds: name -> (smallest, largest).
        reach: the widest angle from the axis that is tried, in radians; of a projection, if there are several.
        sizes: name -> how many numbers, where the model leaves that open.
        project: the model's function by default.
        left_out: names that are not fitted but follow, by ``complete``.
        complete: adds intrinsics that follow from fitted ones.
    """

    camera_class: type[Camera]
    starts: Callable[[FittedModel, Samples], Iterable[Tensor]]
    num_coefficients: tuple[int, ...] = ()
    projections: tuple[str, ...] = ()
    bounds: dict[str, tuple[float, float]] = field(default_factory=dict)
    reach: float | Callable[[str], float] = math.pi
    sizes: Mapping[str, int] = field(default_factory=dict)
    project: Callable[..., Projection] | None = None
    left_out: tuple[str, ...] = ()
    complete: Callable[[dict[str, Any]], dict[str, Any]] | None = None

    def make(self, num_coefficients: int, projection: str) -> FittedModel:
        """The model of a number of coefficients and a projection, which most models do not heed."""
        sizes: dict[str, int | None] = {}
        missing: dict[str, None] = {}
        options: dict[str, str] = {}
        for name, declared in self.camera_class.declared.items():
            if isinstance(declared, Choice):
                options[name] = projection or declared.default
            elif (
                isinstance(declared, Intrinsic) and name not in self.left_out and declared.default is not None
            ):
                size = self.sizes.get(name, num_coefficients)
                if len(declared.sizes) < 2 and declared.sizes != (ANY,):
                    sizes[name] = declared.sizes[0] if declared.sizes else None
                elif size:
                    sizes[name] = size
                else:
                    missing[name] = None
        return FittedModel(
            self,
            self.project or partial(self.camera_class.functions[0], **options),
            sizes,
            missing | options,
            self.reach(projection) if callable(self.reach) else self.reach,
        )


_CHOICES: dict[type[Camera], FitChoices] = {}


def fitted(camera_class: type[Camera], *arguments: Any, **options: Any) -> None:
    """Say how a camera class is fitted, by the arguments of ``FitChoices``: ``convert`` then converts to it."""
    _CHOICES[camera_class] = FitChoices(camera_class, *arguments, **options)


def fit_choices(camera_class: type[Camera]) -> FitChoices | None:
    """How a camera class is fitted, or None if it says nothing of it."""
    return _CHOICES.get(camera_class)


def fitted_classes() -> list[type[Camera]]:
    """All camera classes that say how they are fitted."""
    return list(_CHOICES)


def with_shapes(
    model: FittedModel, samples: Samples, shapes: Iterable[Sequence[float]]
) -> list[Float[Tensor, " p"]]:
    """The two best vectors of models that scale and shift a unit image, which numbers beyond that shape.

    For each shape, focal lengths and principal point follow by linear least squares.
    """
    candidates = []
    for numbers in shapes:
        shape = samples.pixels.new_tensor(list(numbers))
        unit = torch.cat((shape.new_ones(2), shape.new_zeros(2), shape))
        plane, valid = model.pixels(unit, samples.directions)
        valid = valid & plane.isfinite().all(-1)
        if valid.sum() < 3:
            continue
        x, y = plane[valid], samples.pixels[valid]
        centred = x - x.mean(0)
        focal_length = (centred * (y - y.mean(0))).sum(0) / (centred * centred).sum(0)
        center = y.mean(0) - focal_length * x.mean(0)
        rms = float((focal_length * x + center - y).square().mean().sqrt())
        candidates.append((int((~valid).sum()), rms, torch.cat((focal_length, center, shape))))
    return [vector for *_, vector in sorted(candidates, key=lambda entry: entry[:2])[:2]]


def shape_grid(*axes: Sequence[float]) -> Callable[[FittedModel, Samples], list[Tensor]]:
    """Starts from all combinations of shape numbers, with zeros behind them."""

    def starts(model: FittedModel, samples: Samples) -> list[Tensor]:
        zeros = (0.0,) * (sum(size or 1 for size in model.sizes.values()) - 4 - len(axes))
        return with_shapes(model, samples, [(*shape, *zeros) for shape in itertools.product(*axes)])

    return starts


def solve_linear(columns: Float[Tensor, "m k"], target: Float[Tensor, " m"]) -> Float[Tensor, " k"]:
    """Linear least squares with columns of unit length, the same to the last digit in each run.

    Torch's own solver is not: MKL's QR with pivots adds in another order with each address of the memory, and the
    polynomials of lenses, whose powers are all but dependent, show it in their tenth digit.
    """
    length = columns.norm(dim=0)
    solution = np.linalg.lstsq((columns / length).cpu().numpy(), target.cpu().numpy(), rcond=None)[0]
    return torch.from_numpy(solution).to(columns) / length
