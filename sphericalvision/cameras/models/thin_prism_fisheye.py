# SPDX-License-Identifier: Apache-2.0
"""The Kannala-Brandt fisheye with tangential and thin prism distortion: COLMAP's, Metashape's, Project Aria's.

Convention:
    The fisheye's image is the plane point p = θ (x, y) / hypot(x, y), the angle from the axis along the azimuth.
    Radially distorted it is q = g(|p|²) p with g(s) = 1 + k1 s + k2 s² + ... Tangential and thin prism terms T, in
    OpenCV's order and signs, act on one of the two:

    - ``"sequential"``: q + T(q), Project Aria's ``FisheyeRadTanThinPrism``;
    - ``"additive"``: q + T(p), COLMAP's ``THIN_PRISM_FISHEYE`` and Metashape's fisheye.
"""

from __future__ import annotations

from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor, addcmul

from sphericalvision.cameras.base import Projection, Unprojection
from sphericalvision.cameras.checks import model_function
from sphericalvision.cameras.declaration import Choice, ImageSize, Intrinsic, MaxAngle
from sphericalvision.cameras.fitting import fitted
from sphericalvision.cameras.models.image_plane import PlaneCamera, pixels_from_plane, plane_from_pixels
from sphericalvision.cameras.models.kannala_brandt import (
    radial_starts,
    tabulated,
    unproject_kannala_brandt,
    widest_angle,
)
from sphericalvision.cameras.models.plane_distortion import Jacobian, invert_plane_map
from sphericalvision.cameras.registry import register_camera
from sphericalvision.core import check_choice
from sphericalvision.geometry.directions import (
    components,
    cosine_and_lifted_sinc,
    from_components,
    lifted_radius,
    unit_directions,
)
from sphericalvision.geometry.rootfinding import polynomial, with_leading_one

Composition = Literal["sequential", "additive"]
COMPOSITIONS: tuple[str, ...] = get_args(Composition)

_Mapped = tuple[Tensor, Tensor, Jacobian]
"""The image (u, v) of a place of the plane, and the derivatives there."""


def _prism(x: Tensor, y: Tensor, tangential: Tensor, thin_prism: Tensor) -> _Mapped:
    """The terms T at (x, y)."""
    p1, p2 = tangential.unbind(-1)
    s1, s2, s3, s4 = thin_prism.unbind(-1)
    squared = addcmul(x * x, y, y)
    along_u, along_v = addcmul(s1, s2, squared), addcmul(s3, s4, squared)
    u = 2 * p1 * x * y + p2 * (squared + 2 * x * x) + along_u * squared
    v = 2 * p2 * x * y + p1 * (squared + 2 * y * y) + along_v * squared
    mixed = 2 * (p1 * x + p2 * y)
    slope_u, slope_v = 2 * (along_u + s2 * squared), 2 * (along_v + s4 * squared)
    return (
        u,
        v,
        Jacobian(
            2 * p1 * y + 6 * p2 * x + slope_u * x,
            mixed + slope_u * y,
            mixed + slope_v * x,
            6 * p1 * y + 2 * p2 * x + slope_v * y,
        ),
    )


def _sequential(x: Tensor, y: Tensor, tangential: Tensor, thin_prism: Tensor) -> _Mapped:
    """q + T(q) at q = (x, y)."""
    u, v, slopes = _prism(x, y, tangential, thin_prism)
    return x + u, y + v, Jacobian(1 + slopes.ux, slopes.uy, slopes.vx, 1 + slopes.vy)


def _additive(x: Tensor, y: Tensor, coefficients: Tensor, tangential: Tensor, thin_prism: Tensor) -> _Mapped:
    """g(|p|²) p + T(p) at p = (x, y)."""
    u, v, slopes = _prism(x, y, tangential, thin_prism)
    factor, slope = polynomial(coefficients, addcmul(x * x, y, y))
    twice = 2 * slope
    across = twice * x * y
    jacobian = Jacobian(
        addcmul(factor, twice * x, x) + slopes.ux,
        across + slopes.uy,
        across + slopes.vx,
        addcmul(factor, twice * y, y) + slopes.vy,
    )
    return addcmul(u, factor, x), addcmul(v, factor, y), jacobian


@model_function
def project_thin_prism_fisheye(
    points: Float[Tensor, "*#batch 3"],
    focal_length: Float[Tensor, "*#batch 2"],
    principal_point: Float[Tensor, "*#batch 2"],
    distortion: Float[Tensor, "*#batch k"],
    tangential: Float[Tensor, "*#batch 2"],
    thin_prism: Float[Tensor, "*#batch 4"],
    composition: str = "sequential",
) -> Projection:
    """Pixels (*, 2) of ``points`` (*, 3) through a fisheye whose lens elements or sensor are tilted.

    Valid up to the angle where the radial part stops growing, and where the whole keeps orientation.

    Args:
        points: (*, 3) in the camera's frame, any length.
        focal_length: (*, 2) in pixels.
        principal_point: (*, 2) as (u, v).
        distortion: (*, k) as (k1, ..., kk), the radial part.
        tangential: (*, 2) as (p1, p2).
        thin_prism: (*, 4) as (s1, s2, s3, s4): s1 r² + s2 r⁴ along u and s3 r² + s4 r⁴ along v.
        composition: ``"sequential"`` (Project Aria) or ``"additive"`` (COLMAP, Metashape), as above.

    Raises:
        ArgumentError: another ``composition``.

    References:
        J. Weng, P. Cohen, M. Herniou, "Camera calibration with distortion models and accuracy evaluation", PAMI 14
        (1992); J. Engel et al., "Project Aria: a new tool for egocentric multi-modal AI research", arXiv 2308.13561.

    Examples:
        >>> lens = [torch.tensor(x) for x in ([100.0, 100.0], [320.0, 240.0], [0.0], [0.0, 0.0], [0.01, 0.0, 0.0, 0.0])]
        >>> project_thin_prism_fisheye(torch.tensor([1.0, 0.0, 1.0]), *lens).pixels  # 25 π + (π / 4)²
        tensor([399.1567, 240.0000])
    """
    check_choice("composition", composition, COMPOSITIONS)
    coefficients = with_leading_one(distortion)
    x, y, z = components(points)
    radius = lifted_radius(x, y, z)
    angle = torch.atan2(radius, z)
    scale = angle / radius
    x, y = x * scale, y * scale
    if composition == "sequential":
        factor, _ = polynomial(coefficients, addcmul(x * x, y, y))
        u, v, slopes = _sequential(x * factor, y * factor, tangential, thin_prism)
    else:
        u, v, slopes = _additive(x, y, coefficients, tangential, thin_prism)
    valid = (angle <= widest_angle(coefficients)) & (slopes.determinant > 0)
    return Projection(pixels_from_plane(u, v, focal_length, principal_point), valid)


@model_function
def unproject_thin_prism_fisheye(
    pixels: Float[Tensor, "*#batch 2"],
    focal_length: Float[Tensor, "*#batch 2"],
    principal_point: Float[Tensor, "*#batch 2"],
    distortion: Float[Tensor, "*#batch k"],
    tangential: Float[Tensor, "*#batch 2"],
    thin_prism: Float[Tensor, "*#batch 4"],
    composition: str = "sequential",
) -> Unprojection:
    """Unit directions (*, 3) of ``pixels`` (*, 2): the inverse of ``project_thin_prism_fisheye``, by Newton's method.

    The arguments are those of ``project_thin_prism_fisheye``.

    Examples:
        >>> lens = [torch.tensor(x) for x in ([100.0, 100.0], [320.0, 240.0], [0.0], [0.0, 0.0], [0.01, 0.0, 0.0, 0.0])]
        >>> unproject_thin_prism_fisheye(torch.tensor([320.0, 240.0]), *lens).directions.tolist()
        [0.0, 0.0, 1.0]
    """
    check_choice("composition", composition, COMPOSITIONS)
    coefficients = with_leading_one(distortion)
    u, v = plane_from_pixels(pixels, focal_length, principal_point)
    u, v, near = _within_reach(u, v, coefficients)
    if composition == "sequential":
        radial = invert_plane_map(lambda x, y: _sequential(x, y, tangential, thin_prism), u, v, (u, v))
        position = from_components(radial.x, radial.y)
        unit, zero = torch.ones_like(focal_length), torch.zeros_like(principal_point)
        directions, valid = unproject_kannala_brandt(position, unit, zero, distortion)
        return Unprojection(directions, valid & radial.converged & near)
    angles = invert_plane_map(
        lambda x, y: _additive(x, y, coefficients, tangential, thin_prism),
        u,
        v,
        _radial_start(u, v, coefficients),
    )
    squared = addcmul(angles.x * angles.x, angles.y, angles.y)
    cosine, sinc = cosine_and_lifted_sinc(squared)
    widest = widest_angle(coefficients) * (1 + 16 * torch.finfo(u.dtype).eps)
    valid = angles.converged & near & (squared <= widest * widest)
    return Unprojection(unit_directions(angles.x * sinc, angles.y * sinc, cosine), valid)


def _within_reach(u: Tensor, v: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(u, v), brought to 1.5 of the largest radius of the lens where they are farther, and whether they are not."""
    with torch.no_grad():
        widest = widest_angle(coefficients)
        most = 1.5 * widest * polynomial(coefficients, widest * widest)[0]
        squared = addcmul(u * u, v, v)
        inside = squared <= most * most
        shrink = torch.where(inside, 1.0, most / squared.sqrt().clamp_min(torch.finfo(u.dtype).tiny))
    finite = shrink.isfinite() & (shrink > 0)
    return torch.where(finite, u * shrink, 0.0), torch.where(finite, v * shrink, 0.0), inside & finite


def _radial_start(u: Tensor, v: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor]:
    """p were there no tangential and thin prism distortion, to some digits."""
    with torch.no_grad():
        squared = addcmul(u * u, v, v)
        inverse = tabulated(coefficients, widest_angle(coefficients))
        inside = inverse.lookup(torch.minimum(squared, inverse.most)).clamp_min(0)
        scale = (inside / squared.clamp_min(torch.finfo(u.dtype).tiny)).sqrt()
        scale = torch.where(squared > torch.finfo(u.dtype).eps, scale, 1.0)
        return u.detach() * scale, v.detach() * scale


@register_camera
class ThinPrismFisheyeCamera(PlaneCamera):
    """A fisheye camera with tangential and thin prism distortion: Aria's Fisheye624, COLMAP's THIN_PRISM_FISHEYE.

    See ``project_thin_prism_fisheye``, also for ``composition``.

    Examples:
        >>> lens = ([240.0, 240.0], [319.5, 239.5], [-0.02, 0.1, -0.08, 0.02], [1e-4, -2e-4], [1e-3, 0, 5e-4, 0])
        >>> camera = ThinPrismFisheyeCamera(*lens, (480, 640), 1.3)
        >>> direction = torch.tensor([0.0, 0.6, 0.8])
        >>> again = camera.unproject(camera.project(direction).pixels).directions
        >>> bool((again - direction).abs().max() < 1e-6)
        True
    """

    model = "thin_prism_fisheye"
    is_endless = True
    functions = project_thin_prism_fisheye, unproject_thin_prism_fisheye

    distortion: Intrinsic = Intrinsic(*range(1, 10), named="k1 k2 k3 k4 k5 k6 k7 k8 k9")
    tangential: Intrinsic = Intrinsic(2, named="p1 p2")
    thin_prism: Intrinsic = Intrinsic(4, named="s1 s2 s3 s4")
    image_size: ImageSize = ImageSize()
    max_angle: MaxAngle = MaxAngle(default=None)
    composition: Choice = Choice(*COMPOSITIONS, default="sequential")

    def _model_end(self) -> Tensor:
        return widest_angle(with_leading_one(self.distortion))


fitted(ThinPrismFisheyeCamera, radial_starts, num_coefficients=(4, 1, 2, 3, 5, 6, 7, 8, 9))
