# SPDX-License-Identifier: Apache-2.0
"""Any axially symmetric camera as an OCam model, the only one that the stereo sets' calibration files "
"can hold."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from sphericalvision.cameras import Camera, OCamCamera
from sphericalvision.core import ArgumentError

__all__ = ["OCamFit", "fit_ocam", "ocam_from_camera"]

Floats = npt.NDArray[np.float64]

_GOOD_ENOUGH = 1e-3  # pixels; the shortest polynomial that reaches it is taken
_MOST_COEFFICIENTS = 18


class OCamFit(NamedTuple):
    """An OCam camera in float64 and its largest deviation from the original in pixels, projecting or "
    "unprojecting."""

    camera: OCamCamera
    residual: float


def ocam_from_camera(camera: Camera, max_residual: float = 0.1) -> OCamCamera:
    """OCam camera with direct and inverse polynomial that images like ``camera``.

    Args:
        camera: unbatched; axially symmetric up to different scales of the two pixel axes. An ``OCamCamera``
            that has its inverse polynomial is returned as it is.
        max_residual: largest deviation accepted, in pixels.

    Raises:
        ArgumentError: no polynomial comes that close, or the camera is batched.

    References:
        Scaramuzza et al., A Toolbox for Easily Calibrating Omnidirectional Cameras, IROS 2006.

    Examples:
        >>> import math
        >>> from sphericalvision.cameras import FisheyeCamera
        >>> fisheye = FisheyeCamera.from_field_of_view((800, 768), math.radians(220))
        >>> ocam = ocam_from_camera(fisheye)
        >>> bool((ocam.inverse_polynomial[1] - fisheye.focal_length).abs().max() < 1e-4)  # rho = f * angle
        True
    """
    if isinstance(camera, OCamCamera) and camera.inverse_polynomial is not None:
        return camera
    ocam, residual = fit_ocam(camera)
    if not residual <= max_residual:
        raise ArgumentError(
            f"camera: the best OCam model of this {type(camera).__name__} is off by {residual:.3g} px, "
            f"more than max_residual = {max_residual:g} px. Use an OCamCamera, or a smaller max_angle."
        )
    return ocam


def fit_ocam(camera: Camera) -> OCamFit:
    """Fit both OCam polynomials to a camera by least squares over all angles from its axis.

    Raises:
        ArgumentError: the camera is batched or has no forward axis to fit around.
    """
    if tuple(camera.batch_shape):
        raise ArgumentError(f"camera: expected a single camera, got a batch {tuple(camera.batch_shape)}")
    camera = camera.to(torch.float64)
    angle = np.linspace(0.0, float(camera.max_angle), 2001)
    center = _project(camera, np.zeros(1), 0.0)[0]
    if isinstance(camera, OCamCamera):
        affine = np.asarray(camera.affine.detach().cpu())
        radius = _undo_affine(_project(camera, angle, 0.0) - center, affine)
    else:
        along_u = _project(camera, angle, 0.0)[:, 0] - center[0]
        along_v = _project(camera, angle, math.pi / 2)[:, 1] - center[1]
        affine = np.array([along_v @ along_u / (along_u @ along_u), 0.0, 0.0])
        radius = along_u
    if not np.isfinite(radius).all() or not (np.diff(radius) > 0).all():
        raise ArgumentError(
            f"camera: this {type(camera).__name__} does not image growing angles at growing radii up to "
            f"its max_angle of {math.degrees(angle[-1]):.1f} degrees, which an OCam model needs. Give a "
            "smaller max_angle."
        )
    inverse = _fit_inverse(angle, radius)
    if isinstance(camera, OCamCamera):
        direct = np.asarray(camera.polynomial.detach().cpu())
        direct_residual = 0.0
    else:
        direct, direct_residual = _fit_direct(angle, radius)
    ocam = OCamCamera(
        polynomial=torch.from_numpy(direct),
        inverse_polynomial=torch.from_numpy(inverse),
        principal_point=torch.from_numpy(center),
        affine=torch.from_numpy(affine),
        image_size=camera.image_size,
        max_angle=camera.max_angle,
    )
    azimuths = np.linspace(0.0, 2 * math.pi, 16, endpoint=False)
    gaps = [_project(ocam, angle, azimuth) - _project(camera, angle, azimuth) for azimuth in azimuths]
    residual = max(np.linalg.norm(gap, axis=-1).max() for gap in gaps)
    return OCamFit(ocam, max(float(residual), direct_residual))


def _project(camera: Camera, angle: Floats, azimuth: float) -> Floats:
    """Pixels (n, 2) of directions at angles from the axis, in the half plane of an azimuth (0 is right)."""
    across = np.sin(angle)
    points = np.stack((across * math.cos(azimuth), across * math.sin(azimuth), np.cos(angle)), axis=-1)
    with torch.no_grad():
        return camera.project(torch.from_numpy(points)).pixels.numpy()


def _undo_affine(offset: Floats, affine: Floats) -> Floats:
    """Radius of pixel offsets (n, 2) as (u, v) before the affine map row = c row' + d col', col = e row' "
    "+ col'."""
    c, d, e = affine
    row_column = np.linalg.solve(np.array([[c, d], [e, 1.0]]), offset[:, ::-1].T)
    return np.hypot(*row_column)


def _fit_inverse(angle: Floats, radius: Floats) -> Floats:
    """Coefficients of radius in ascending powers of the angle from the image plane, axis angle - pi / 2."""
    theta = angle - math.pi / 2
    for num_coefficients in range(2, _MOST_COEFFICIENTS + 1):
        fit = np.polynomial.Chebyshev.fit(theta, radius, num_coefficients - 1)
        polynomial = fit.convert(kind=np.polynomial.Polynomial)
        if np.abs(polynomial(theta) - radius).max() < _GOOD_ENOUGH:
            break
    return np.asarray(polynomial.coef, dtype=np.float64)


def _fit_direct(angle: Floats, radius: Floats) -> tuple[Floats, float]:
    """Coefficients of radius * tan(theta) in powers 0, 2, 3, ... of the radius, and the largest error in "
    "pixels."""
    angle, radius = angle[1:], radius[1:]  # on the axis the tangent is infinite and the radius zero
    theta = angle - math.pi / 2
    scale = radius[-1]
    # A change of the polynomial by 1 turns the ray by cos(theta)^2 / radius, that is by so many pixels:
    pixels_per_unit = np.cos(theta) ** 2 / radius * np.gradient(radius, angle)
    target = radius * np.tan(theta)
    best, least = np.zeros(1), math.inf
    for num_coefficients in range(4, _MOST_COEFFICIENTS + 1):
        powers = np.array([0, *range(2, num_coefficients)])
        basis = (radius[:, None] / scale) ** powers
        solution = np.linalg.lstsq(basis * pixels_per_unit[:, None], target * pixels_per_unit, rcond=None)[0]
        turned = np.arctan2(basis @ solution, radius)
        residual = float(np.abs(np.interp(turned, theta, radius) - radius)[:-1].max())
        if residual < least:
            best, least = np.insert(solution / scale**powers, 1, 0.0), residual
        if least < _GOOD_ENOUGH:
            break
    return best, least
