# SPDX-License-Identifier: Apache-2.0
"""Any lens as an OCam model with both polynomials, the only one that the stereo sets' calibration files can hold."""

from __future__ import annotations

import math

import torch

from sphericalvision.cameras import Camera, EquirectangularCamera, OCamCamera, convert
from sphericalvision.cameras.field_of_view import visible_angle
from sphericalvision.core import ArgumentError

__all__ = ["ocam_from_camera"]

_MOST_COEFFICIENTS = 18


def ocam_from_camera(camera: Camera, max_residual: float = 0.1) -> OCamCamera:
    """OCam camera with direct and inverse polynomial that images like ``camera``, in float64.

    Args:
        camera: unbatched. An ``OCamCamera`` that has its inverse polynomial is returned as it is.
        max_residual: largest deviation accepted, in pixels.

    Raises:
        ArgumentError: no polynomial comes that close over all that the camera sees, or the camera is a batch
            or a panorama.

    References:
        Scaramuzza et al., A Toolbox for Easily Calibrating Omnidirectional Cameras, IROS 2006.

    Examples:
        >>> from sphericalvision.cameras import FisheyeCamera
        >>> fisheye = FisheyeCamera.from_field_of_view((800, 768), math.radians(220))
        >>> ocam = ocam_from_camera(fisheye)
        >>> ray = fisheye.unproject(torch.tensor([100.0, 500.0])).directions
        >>> ocam.project(ray.double()).pixels.round().tolist()
        [100.0, 500.0]
    """
    if isinstance(camera, OCamCamera) and camera.inverse_polynomial is not None:
        return camera
    if isinstance(camera, EquirectangularCamera):
        raise ArgumentError(
            "camera: a panorama has no OCam model, which images growing angles at growing radii; reproject its images "
            "to a lens with remap(...)"
        )
    exact = camera.to(torch.float64)
    fit = convert(exact, to=OCamCamera)
    if fit.max_error > max_residual:
        fit = convert(exact, to=OCamCamera, num_coefficients=_MOST_COEFFICIENTS)
    azimuths = torch.arange(64, dtype=torch.float64) * (math.pi / 32)
    lost = float(visible_angle(exact, azimuths).max()) - fit.covered_angle
    if not fit.max_error <= max_residual or lost > 1e-3:
        raise ArgumentError(
            f"camera: the best OCam model of this {type(camera).__name__} is off by {fit.max_error:.3g} px out to "
            f"{math.degrees(fit.covered_angle):.1f} degrees, more than max_residual = {max_residual:g} px or less "
            "than the camera sees. Use an OCamCamera, or a smaller max_angle."
        )
    assert isinstance(fit.camera, OCamCamera)
    return fit.camera
