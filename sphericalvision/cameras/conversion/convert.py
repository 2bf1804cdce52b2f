# SPDX-License-Identifier: Apache-2.0
"""Any camera as another model: fitted over the field of view, with the distance of the two in pixels."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from sphericalvision.cameras.base import Camera, check_single
from sphericalvision.cameras.conversion.fit import ROUNDS, cannot_show, fit_model
from sphericalvision.cameras.field_of_view import cap, directions_around_axis, visible_angle
from sphericalvision.cameras.fitting import FittedModel, fit_choices, fitted_classes
from sphericalvision.cameras.model_alone import project_by_model
from sphericalvision.cameras.models.brown_conrady import BrownConradyCamera
from sphericalvision.cameras.models.equirectangular import EquirectangularCamera
from sphericalvision.cameras.models.ocam import OCamCamera
from sphericalvision.cameras.models.ocam_polynomials import fit_direct, fit_inverse_polynomial
from sphericalvision.cameras.models.pinhole import PinholeCamera
from sphericalvision.cameras.registry import camera_model_meant, camera_model_names
from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.geometry import angle_from_axis
from sphericalvision.geometry.rootfinding import polynomial

_HELD_OUT = 12_000  # directions in the cap of the field of view; fewer are on the image


class Conversion(NamedTuple):
    """A camera of another model, and how well it stands in for the original."""

    camera: Camera
    """The new camera; its ``max_angle`` is ``covered_angle``."""
    max_error: float
    """Largest distance in pixels between the projections of the two, over directions that were not fitted."""
    rms_error: float
    """Root mean square of these distances over the solid angle."""
    covered_angle: float
    """The angle from the axis, in radians, out to which the model was fitted and the errors hold; less than the
    original's view where the new model cannot reach as far."""


@torch.no_grad()
def convert(
    camera: Camera,
    to: type[Camera] | str,
    *,
    max_angle: float | None = None,
    num_coefficients: int | None = None,
    projection: str | None = None,
) -> Conversion:
    """Fit another camera model to ``camera`` over its field of view.

    Directions evenly over the part of the sphere that the camera sees are projected by it; the new intrinsics are those
    that bring the new model's pixels closest in the mean square (Levenberg-Marquardt in float64, from several starts).
    The errors are taken at twenty times as many other directions and along the edge of the view. The new camera has the
    dtype and device of the old one; convert a float64 camera for the last digits.

    A model of the image plane cannot show 90°: ``PinholeCamera`` and ``BrownConradyCamera`` are fitted out to 80°
    unless the original ends before or ``max_angle`` says otherwise; any model is fitted only as far as it
    stays one-to-one. ``covered_angle`` says how far that is.

    The new camera stands in the same frame. Only ``OCamCamera`` can turn its image about the axis (d ≈ −e, often by a
    degree or two in calibrations): no other model can follow, and the errors say by how many pixels. Convert
    ``straighten(camera).camera``, which stands in a turned frame, or the cameras of ``straighten_rig(rig)``.

    An OCam camera holds two polynomials: the inverse one is fitted to the projection, and the direct one to that; both
    count in the errors.

    Args:
        camera: a single camera.
        to: class of the new model, or its name in files, such as ``"kannala_brandt"``, or a name that readers know for
            it: ``"kb4"``, ``"ds"``, ``"eucm"``, ``"mei"``, ``"radtan"``.
        max_angle: radians from the axis out to which the fit matters, within what the camera sees.
        num_coefficients: of ``BrownConradyCamera`` (4, 5, 8, 12, 14; 8 by default), ``UnifiedCamera`` (0, 4, 5; 4),
            ``KannalaBrandtCamera`` and ``ThinPrismFisheyeCamera`` (1 to 9; 4), ``DivisionCamera`` (1 to 6; 2),
            ``RadialPolynomialCamera`` (1 to 12; 4), and of the inverse polynomial of ``OCamCamera`` (2 to 18; 12).
            A camera of the same model keeps its own number.
        projection: of ``FisheyeCamera``; by default the one that fits best.

    Raises:
        ArgumentError: the camera is a batch, or sees nothing that the new model could show; the model is not known, or
            an option does not belong to it.

    References:
        K. Levenberg (1944), D. Marquardt (1963); see ``solve_least_squares``.

    Examples:
        >>> from sphericalvision.cameras import DoubleSphereCamera, KannalaBrandtCamera
        >>> lens = DoubleSphereCamera([300.0, 300.0], [609.5, 607.5], -0.2, 0.6, (1216, 1216), math.radians(100))
        >>> conversion = convert(lens, to=KannalaBrandtCamera)
        >>> conversion.max_error < 0.1
        True
    """
    check_single(camera)
    to = _model(to)
    if to is EquirectangularCamera:
        return _panorama(camera)
    if isinstance(camera, EquirectangularCamera):
        raise ArgumentError(
            f"to: no {to.__name__} can stand for a panorama, whose pixels are no lens's; "
            "bring its images to such a camera with sphericalvision.cameras.remapping.remap"
        )
    candidates = _candidates(camera, to, num_coefficients, projection)
    exact = camera.to(torch.float64)
    azimuth = torch.arange(360, dtype=torch.float64, device=camera.device) * (math.pi / 180)
    edge = visible_angle(exact, azimuth)
    limit = float(edge.max())
    if max_angle is not None:
        if not 0 < max_angle < 3.1416:
            raise ArgumentError(
                f"max_angle: expected radians above 0 up to π, got {max_angle}; are these degrees?"
            )
        limit = min(limit, max_angle)
    held_out = torch.cat(
        (cap(limit, _HELD_OUT, exact), directions_around_axis(edge.clamp_max(limit) * (1 - 1e-9), azimuth))
    )
    if to is OCamCamera and isinstance(camera, OCamCamera):
        ocam = _complete(camera, num_coefficients).with_max_angle(limit)
        return Conversion(ocam, *_errors(exact, ocam, held_out, limit), limit)
    if type(camera) is to and getattr(camera, "skew", None) is not None and num_coefficients is None:
        same = camera.with_max_angle(limit)  # no fit has a skew
        return Conversion(same, *_errors(exact, same, held_out, limit), limit)
    fits = [fit_model(exact, model, held_out, _reach(model, exact, limit, max_angle)) for model in candidates]
    model, vector, covered, _ = min(fits, key=lambda fit: (-round(fit.covered_angle, 3), fit.rms))
    result = model.build(vector, camera.image_size, covered, camera)
    if isinstance(result, OCamCamera):
        result, covered = _with_direct_polynomial(result, held_out, covered)
    return Conversion(result, *_errors(exact, result, held_out, covered), covered)


def _model(to: type[Camera] | str) -> type[Camera]:
    model = camera_model_meant(to) if isinstance(to, str) else to
    if model is None:
        check_choice("to", to, camera_model_names())
    if not (isinstance(model, type) and issubclass(model, Camera)):
        raise ArgumentError(
            f"to: expected a camera class, or one of {', '.join(camera_model_names())}, got {to!r}"
        )
    return model


def _candidates(
    camera: Camera, to: type[Camera], num_coefficients: int | None, projection: str | None
) -> list[FittedModel]:
    choices = fit_choices(to)
    if choices is None:
        names = ", ".join(kind.__name__ for kind in fitted_classes())
        raise ArgumentError(
            f"to: expected one of {names}; {to.__name__} does not say how it is fitted "
            "(sphericalvision.cameras.fitting.fitted)"
        )
    if num_coefficients is not None and num_coefficients not in choices.num_coefficients:
        allowed = ", ".join(map(str, sorted(choices.num_coefficients)))
        raise ArgumentError(
            f"num_coefficients: {to.__name__} "
            + (f"has {allowed} coefficients" if allowed else "leaves no choice of it")
            + f", got {num_coefficients}"
        )
    if projection is not None and not choices.projections:
        raise ArgumentError(f"projection: only FisheyeCamera has a choice of it, not {to.__name__}")
    if projection is not None:
        check_choice("projection", projection, choices.projections)
    if num_coefficients is None and choices.num_coefficients:
        num_coefficients = _own_number(camera, to) or choices.num_coefficients[0]
    if type(camera) is to and projection is None:
        projection = getattr(camera, "projection", None)
    projections = [projection] if projection else list(choices.projections) or [""]
    return [choices.make(num_coefficients or 0, name) for name in projections]


def _own_number(camera: Camera, to: type[Camera]) -> int | None:
    """How many coefficients a camera of the wanted model has itself."""
    if type(camera) is not to:
        return None
    for name in ("distortion", "inverse_polynomial", "polynomial"):
        if name in camera.intrinsic_names:
            values = getattr(camera, name)
            return None if values is None else len(values)
    return None


def _panorama(camera: Camera) -> Conversion:
    if not isinstance(camera, EquirectangularCamera):
        raise ArgumentError(
            "to: an EquirectangularCamera has no intrinsics that could be fitted; to see a lens as a panorama, "
            "reproject its images"
        )
    return Conversion(camera, 0.0, 0.0, float(camera.max_angle))


def _reach(model: FittedModel, camera: Camera, limit: float, max_angle: float | None) -> float:
    """How far out a model is fitted at first."""
    plane = (PinholeCamera, BrownConradyCamera)
    if issubclass(model.choices.camera_class, plane):
        if max_angle is not None and max_angle >= math.pi / 2:
            raise ArgumentError(
                f"max_angle: a {model.choices.camera_class.__name__} ends before 90° from the axis, got "
                f"{math.degrees(max_angle):.1f}°"
            )
        if max_angle is not None or isinstance(camera, plane):
            return min(limit, math.radians(89.99))
    return min(limit, model.reach)


def _with_direct_polynomial(ocam: OCamCamera, held_out: Tensor, covered: float) -> tuple[OCamCamera, float]:
    """The camera with a direct polynomial that inverts its inverse one, and out to which angle both are one-to-one."""
    assert ocam.inverse_polynomial is not None
    result = ocam
    for _ in range(ROUNDS):
        angle = torch.linspace(0, covered, 2049, dtype=torch.float64, device=ocam.device)
        radius = polynomial(ocam.inverse_polynomial.double(), angle - math.pi / 2)[0]
        result = OCamCamera(
            fit_direct(angle, radius).to(ocam.polynomial),
            ocam.inverse_polynomial,
            ocam.principal_point,
            ocam.affine,
            ocam.image_size,
            covered,
        )
        angle = angle_from_axis(held_out)
        inside = project_by_model(result.exact().to(torch.float64), held_out).valid
        lost = angle[~inside & (angle <= covered)]
        if not len(lost):
            break
        covered = float(lost.min()) * (1 - 1e-3)
    return result.with_max_angle(covered), covered


def _complete(camera: OCamCamera, num_coefficients: int | None) -> OCamCamera:
    """The camera itself if it has an inverse polynomial of so many coefficients, else with a fitted one."""
    own = camera.inverse_polynomial
    if own is not None and num_coefficients in (None, len(own)):
        return camera
    return fit_inverse_polynomial(camera, None if num_coefficients is None else num_coefficients - 1).camera


def _errors(original: Camera, new: Camera, directions: Tensor, covered: float) -> tuple[float, float]:
    """Largest and root mean square distance in pixels, over what the original sees out to the covered angle."""
    new = new.to(torch.float64)
    expected, seen = original.project(directions)
    seen = seen & (angle_from_axis(directions) <= covered)
    pairs = [(expected, project_by_model(new, directions).pixels)]
    if isinstance(new, OCamCamera):
        if isinstance(original, OCamCamera):
            expected = project_by_model(original.exact(), directions).pixels
        pairs.append((expected, project_by_model(new.exact(), directions).pixels))
    gaps = [(first - second)[seen].norm(dim=-1) for first, second in pairs]
    even = int(seen[:_HELD_OUT].sum())  # those along the edge, behind, are too many for a mean over the view
    if not even:  # what is covered has shrunk to a spot
        raise cannot_show(original, type(new))
    return (
        max(float(gap.max()) for gap in gaps),
        max(float(gap[:even].square().mean().sqrt()) for gap in gaps),
    )
