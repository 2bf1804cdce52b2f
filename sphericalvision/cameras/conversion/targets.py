# SPDX-License-Identifier: Apache-2.0
"""The models that cameras are converted to: their intrinsics, bounds, options, and where a fit starts.

A new model that ``convert`` shall know is one more entry in ``MODELS``.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from sphericalvision.cameras.base import Camera, Projection
from sphericalvision.cameras.conversion.fit import FittedModel, Samples
from sphericalvision.cameras.models.brown_conrady import BrownConradyCamera, project_brown_conrady
from sphericalvision.cameras.models.double_sphere import DoubleSphereCamera, project_double_sphere
from sphericalvision.cameras.models.extended_unified import ExtendedUnifiedCamera, project_extended_unified
from sphericalvision.cameras.models.fisheye import FISHEYE_PROJECTIONS, FisheyeCamera, project_fisheye
from sphericalvision.cameras.models.kannala_brandt import KannalaBrandtCamera, project_kannala_brandt
from sphericalvision.cameras.models.ocam import OCamCamera, project_ocam
from sphericalvision.cameras.models.pinhole import PinholeCamera, project_pinhole
from sphericalvision.cameras.models.radial_polynomial import RadialPolynomialCamera, project_radial_polynomial
from sphericalvision.cameras.models.unified import UnifiedCamera, project_unified

__all__ = ["MODELS", "Choices"]

_PLANE_REACH = math.radians(
    80
)  # a model of the image plane is fitted up to here, unless the original ends before


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
    return FittedModel(OCamCamera, _project_inverse, sizes, _ocam_start, complete=_before_direct_fit)


def _before_direct_fit(intrinsics: dict[str, Any]) -> dict[str, Any]:
    """A direct polynomial that stands there until it is fitted to the inverse one."""
    return intrinsics | {"polynomial": -intrinsics["inverse_polynomial"].new_ones(1)}


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
