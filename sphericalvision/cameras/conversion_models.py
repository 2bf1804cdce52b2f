# SPDX-License-Identifier: Apache-2.0
"""How each camera model is fitted: its intrinsics as one vector, their bounds, and where to start.

A new model that ``convert`` shall know is one more entry in ``MODELS``.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from sphericalvision.cameras.base import Camera, Projection
from sphericalvision.cameras.brown_conrady import BrownConradyCamera, project_brown_conrady
from sphericalvision.cameras.double_sphere import DoubleSphereCamera, project_double_sphere
from sphericalvision.cameras.extended_unified import ExtendedUnifiedCamera, project_extended_unified
from sphericalvision.cameras.fisheye import FISHEYE_PROJECTIONS, FisheyeCamera, project_fisheye
from sphericalvision.cameras.kannala_brandt import KannalaBrandtCamera, project_kannala_brandt
from sphericalvision.cameras.ocam import OCamCamera, project_ocam
from sphericalvision.cameras.pinhole import PinholeCamera, project_pinhole
from sphericalvision.cameras.radial_polynomial import RadialPolynomialCamera, project_radial_polynomial
from sphericalvision.cameras.unified import UnifiedCamera, project_unified
from sphericalvision.geometry import angle_from_axis

__all__ = ["MODELS", "FittedModel", "Samples"]

_PLANE_REACH = math.radians(
    80
)  # a model of the image plane is fitted up to here, unless the original ends before


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
    """

    camera_class: type[Camera]
    project: Callable[..., Projection]
    sizes: dict[str, int | None]
    starts: Callable[[FittedModel, Samples], Iterable[Tensor]]
    bounds: dict[str, tuple[float, float]] = field(default_factory=dict)
    reach: float = math.pi
    constants: dict[str, Any] = field(default_factory=dict)

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

    def build(self, vector: Tensor, image_size: tuple[int, int], max_angle: float, like: Tensor) -> Camera:
        """The camera of a vector, in the dtype and on the device of ``like``."""
        vector = vector.to(like.device, like.dtype)
        intrinsics: dict[str, Any] = self.intrinsics(vector) | self.constants
        if self.camera_class is OCamCamera:
            intrinsics["polynomial"] = -intrinsics["inverse_polynomial"].new_ones(1)  # until it is fitted
        return self.camera_class(**intrinsics, image_size=image_size, max_angle=max_angle)


def _with_shapes(model: FittedModel, samples: Samples, shapes: Iterable[Sequence[float]]) -> list[Tensor]:
    """The two best vectors of models that scale and shift a unit image, which numbers beyond that shape.

    For each shape, focal lengths and principal point follow by linear least squares.
    """
    tried = []
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
        tried.append((int((~valid).sum()), rms, torch.cat((focal_length, center, shape))))
    return [vector for *_, vector in sorted(tried, key=lambda entry: entry[:2])[:2]]


def _grid(*axes: Sequence[float], then: int = 0) -> Callable[[FittedModel, Samples], list[Tensor]]:
    """Starts from all combinations of shape numbers, with ``then`` zeros behind them."""

    def starts(model: FittedModel, samples: Samples) -> list[Tensor]:
        zeros = (0.0,) * then
        return _with_shapes(model, samples, [(*shape, *zeros) for shape in itertools.product(*axes)])

    return starts


def _radial_start(model: FittedModel, samples: Samples) -> list[Tensor]:
    """Kannala-Brandt: radius − θ = k1 θ³ + k2 θ⁵ + ... is linear."""
    angle = samples.angle
    powers = torch.stack([angle ** (2 * k + 3) for k in range(4)], dim=-1)
    solution = _solve(powers, samples.radius - angle)
    return [
        torch.cat((samples.focal_length, samples.center, solution)),
        *_with_shapes(model, samples, [[0.0] * 4]),
    ]


def _plane_start(model: FittedModel, samples: Samples) -> list[Tensor]:
    """Brown-Conrady: radius (1 + k4 r² + ...) = r (1 + k1 r² + ...) is linear, weighted by the last denominator."""
    size = model.sizes["distortion"] or 0
    r = samples.angle.tan()
    above = [r**3, r**5, r**7][: 2 if size == 4 else 3]
    below = [-samples.radius * r**power for power in (2, 4, 6)] if size >= 8 else []
    columns = torch.stack([*above, *below], dim=-1)
    weight = torch.ones_like(r)
    for _ in range(4 if below else 1):
        solution = _solve(columns * weight.unsqueeze(-1), (samples.radius - r) * weight)
        distortion = r.new_zeros(size)
        distortion[[0, 1, 4][: len(above)]] = solution[: len(above)]
        distortion[5 : 5 + len(below)] = solution[len(above) :]
        denominator = 1 + sum(
            (k * r**power for k, power in zip(solution[len(above) :], (2, 4, 6), strict=False)), 0 * r
        )
        weight = 1 / denominator.abs().clamp_min(1e-3)
    return _with_shapes(model, samples, [distortion.tolist(), [0.0] * size])


def _power_start(model: FittedModel, samples: Samples) -> list[Tensor]:
    """Radial polynomial: the radius in pixels along u is linear in the coefficients."""
    angle = samples.angle
    powers = torch.stack([angle**power for power in range(1, (model.sizes["polynomial"] or 0) + 1)], dim=-1)
    coefficients = _solve(powers, samples.radius * samples.focal_length[0])
    aspect = samples.focal_length[1:] / samples.focal_length[:1]
    parts = {"polynomial": coefficients, "principal_point": samples.center, "aspect_ratio": aspect}
    return [model.vector(parts)]


def _ocam_start(model: FittedModel, samples: Samples) -> list[Tensor]:
    """OCam: so is the inverse polynomial."""
    theta = samples.angle - math.pi / 2
    powers = torch.stack([theta**power for power in range(model.sizes["inverse_polynomial"] or 0)], dim=-1)
    coefficients = _solve(powers, samples.radius * samples.focal_length[0])
    aspect = samples.focal_length[1] / samples.focal_length[0]
    affine = torch.stack((aspect, 0 * aspect, 0 * aspect))
    parts = {"inverse_polynomial": coefficients, "principal_point": samples.center, "affine": affine}
    return [model.vector(parts)]


def _solve(columns: Tensor, target: Tensor) -> Tensor:
    """Linear least squares with columns of unit length."""
    length = columns.norm(dim=0)
    solution = torch.linalg.lstsq(columns / length, target.unsqueeze(-1), driver="gelsd").solution
    return solution.squeeze(-1) / length


def _project_inverse(
    directions: Tensor, inverse_polynomial: Tensor, principal_point: Tensor, affine: Tensor
) -> Projection:
    return project_ocam(directions, inverse_polynomial[:1], inverse_polynomial, principal_point, affine)


_FOCAL: dict[str, int | None] = {"focal_length": 2, "principal_point": 2}


def _pinhole(num_coefficients: int, projection: str) -> FittedModel:
    return FittedModel(PinholeCamera, project_pinhole, _FOCAL, _grid(), reach=_PLANE_REACH)


def _brown_conrady(num_coefficients: int, projection: str) -> FittedModel:
    sizes = _FOCAL | {"distortion": num_coefficients}
    return FittedModel(BrownConradyCamera, project_brown_conrady, sizes, _plane_start, reach=_PLANE_REACH)


def _kannala_brandt(num_coefficients: int, projection: str) -> FittedModel:
    return FittedModel(KannalaBrandtCamera, project_kannala_brandt, _FOCAL | {"distortion": 4}, _radial_start)


def _unified(num_coefficients: int, projection: str) -> FittedModel:
    sizes = _FOCAL | {"xi": None}
    if num_coefficients:
        sizes |= {"distortion": num_coefficients}
    starts = _grid((0.0, 0.25, 0.5, 0.75, 1.0, 1.3, 1.7, 2.2, 3.0), then=num_coefficients)
    constants = {} if num_coefficients else {"distortion": None}
    return FittedModel(
        UnifiedCamera, project_unified, sizes, starts, {"xi": (0.0, 50.0)}, constants=constants
    )


def _extended_unified(num_coefficients: int, projection: str) -> FittedModel:
    starts = _grid((0.0, 0.3, 0.5, 0.6, 0.7, 0.8), (0.5, 0.8, 1.0, 1.3, 2.0, 4.0))
    bounds = {"alpha": (0.0, 1.0), "beta": (1e-3, 1e3)}
    sizes = _FOCAL | {"alpha": None, "beta": None}
    return FittedModel(ExtendedUnifiedCamera, project_extended_unified, sizes, starts, bounds)


def _double_sphere(num_coefficients: int, projection: str) -> FittedModel:
    starts = _grid((-0.4, -0.2, 0.0, 0.2, 0.5, 0.8), (0.0, 0.3, 0.5, 0.6, 0.7, 0.8))
    bounds = {"xi": (-0.999, 0.999), "alpha": (0.0, 1.0)}
    sizes = _FOCAL | {"xi": None, "alpha": None}
    return FittedModel(DoubleSphereCamera, project_double_sphere, sizes, starts, bounds)


def _fisheye(num_coefficients: int, projection: str) -> FittedModel:
    reach = {"orthographic": math.pi / 2, "stereographic": math.radians(179)}.get(projection, math.pi)
    return FittedModel(
        FisheyeCamera,
        partial(project_fisheye, projection=projection),
        _FOCAL,
        _grid(),
        reach=reach,
        constants={"projection": projection},
    )


def _radial_polynomial(num_coefficients: int, projection: str) -> FittedModel:
    sizes = {"polynomial": num_coefficients, "principal_point": 2, "aspect_ratio": None}
    return FittedModel(RadialPolynomialCamera, project_radial_polynomial, sizes, _power_start)


def _ocam(num_coefficients: int, projection: str) -> FittedModel:
    sizes: dict[str, int | None] = {
        "inverse_polynomial": num_coefficients,
        "principal_point": 2,
        "affine": 3,
    }
    return FittedModel(OCamCamera, _project_inverse, sizes, _ocam_start)


class Choices(NamedTuple):
    """A model with the options that it leaves open."""

    make: Callable[[int, str], FittedModel]
    num_coefficients: tuple[int, ...] = ()
    """Allowed numbers of coefficients, the default first."""
    projections: tuple[str, ...] = ()
    """Allowed projections, of which the best is the default."""


MODELS: dict[type[Camera], Choices] = {
    PinholeCamera: Choices(_pinhole),
    BrownConradyCamera: Choices(_brown_conrady, (8, 4, 5, 12, 14)),
    KannalaBrandtCamera: Choices(_kannala_brandt),
    UnifiedCamera: Choices(_unified, (4, 0, 5)),
    ExtendedUnifiedCamera: Choices(_extended_unified),
    DoubleSphereCamera: Choices(_double_sphere),
    FisheyeCamera: Choices(_fisheye, projections=FISHEYE_PROJECTIONS),
    RadialPolynomialCamera: Choices(_radial_polynomial, (4, 1, 2, 3, *range(5, 13))),
    OCamCamera: Choices(_ocam, (12, *range(2, 12), *range(13, 19))),
}
