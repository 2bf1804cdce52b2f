# SPDX-License-Identifier: Apache-2.0
"""The unified model: one sphere and a pinhole; with distortion it is Mei's."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.base import Projection, Unprojection
from sphericalvision.cameras.checks import model_function
from sphericalvision.cameras.declaration import ImageSize, Intrinsic, MaxAngle, OptionalIntrinsic
from sphericalvision.cameras.fitting import fitted, shape_grid
from sphericalvision.cameras.models.image_plane import PlaneCamera, pixels_from_plane, plane_from_pixels
from sphericalvision.cameras.models.plane_distortion import distort_inside, fold_radius, undistort
from sphericalvision.cameras.registry import register_camera
from sphericalvision.core import ArgumentError
from sphericalvision.geometry.directions import components, safe_sqrt, unit_directions


def _widest_cosine(xi: Tensor) -> Tensor:
    """Cosine of the angle at which the model ends: −ξ where the denominator vanishes, −1/ξ where the radius turns."""
    is_bounded = xi > 1
    return -torch.where(is_bounded, 1 / torch.where(is_bounded, xi, 1.0), xi)


def _lift(x: Tensor, y: Tensor, xi: Tensor) -> Unprojection:
    """Directions of the undistorted plane's points."""
    squared = torch.addcmul(x * x, y, y)
    under_root = 1 + (1 - xi * xi) * squared
    scale = (xi + safe_sqrt(under_root)) / (1 + squared)
    return Unprojection(unit_directions(scale * x, scale * y, scale - xi), under_root >= 0)


@model_function
def project_unified(
    points: Float[Tensor, "*#batch 3"],
    focal_length: Float[Tensor, "*#batch 2"],
    principal_point: Float[Tensor, "*#batch 2"],
    xi: Float[Tensor, "*#batch"],
    distortion: Float[Tensor, "*#batch k"] | None = None,
) -> Projection:
    """Pixels (*, 2) of ``points`` (*, 3) through a unit sphere and a pinhole ξ behind its centre.

    The plane's point is (x, y) / (z + ξ |X|). Valid for z > −ξ |X| where ξ ≤ 1, which keeps the denominator positive,
    and for z > −|X| / ξ where ξ > 1: there the radius sin θ / (cos θ + ξ), whose derivative has the sign of
    1 + ξ cos θ, stops growing. With distortion the model also ends where that is no longer one-to-one.

    Args:
        points: (*, 3) in the camera's frame, any length.
        focal_length: (*, 2) in pixels; Mei's γ, which is 1 + ξ times the focal length of the image centre.
        principal_point: (*, 2) as (u, v).
        xi: (*), above −1; 0 is a pinhole, 1 a stereographic lens.
        distortion: (*, 5) as (k1, k2, p1, p2, k3), or (*, 4), of the plane's point, as in ``cv2.omnidir``; or None.

    References:
        C. Mei, P. Rives, "Single view point omnidirectional camera calibration from planar grids", ICRA 2007, section
        II; the domain as V. Usenko, N. Demmel, D. Cremers, "The double sphere camera model", 3DV 2018, section II-B.

    Examples:
        >>> intrinsics = [torch.tensor(x) for x in ([200.0, 200.0], [320.0, 240.0], 1.0)]
        >>> project_unified(torch.tensor([1.0, 0.0, 0.0]), *intrinsics).pixels.tolist()  # 90° to the right
        [520.0, 240.0]
    """
    x, y, z = components(points)
    squared = torch.addcmul(torch.addcmul(x * x, y, y), z, z)
    length = torch.sqrt(squared.clamp_min(torch.finfo(z.dtype).tiny))
    valid = z > _widest_cosine(xi) * length
    # Beyond the model's end points land far outside of the image, in place of a division by 0.
    denominator = torch.maximum(torch.addcmul(z, xi, length), torch.finfo(z.dtype).eps * length)
    x, y = x / denominator, y / denominator
    if distortion is not None:
        x, y, one_to_one = distort_inside(x, y, distortion)
        valid = valid & one_to_one
    return Projection(pixels_from_plane(x, y, focal_length, principal_point), valid)


@model_function
def unproject_unified(
    pixels: Float[Tensor, "*#batch 2"],
    focal_length: Float[Tensor, "*#batch 2"],
    principal_point: Float[Tensor, "*#batch 2"],
    xi: Float[Tensor, "*#batch"],
    distortion: Float[Tensor, "*#batch k"] | None = None,
) -> Unprojection:
    """Unit directions (*, 3) of ``pixels`` (*, 2): the inverse of ``project_unified``, with the same arguments.

    In closed form; the distortion is undone by Newton's method.

    Examples:
        >>> intrinsics = [torch.tensor(x) for x in ([200.0, 200.0], [320.0, 240.0], 1.0)]
        >>> unproject_unified(torch.tensor([520.0, 240.0]), *intrinsics).directions.tolist()
        [1.0, 0.0, 0.0]
    """
    x, y = plane_from_pixels(pixels, focal_length, principal_point)
    if distortion is None:
        return _lift(x, y, xi)
    x, y, converged = undistort(x, y, distortion)
    directions, valid = _lift(x, y, xi)
    return Unprojection(directions, valid & converged)


@register_camera
class UnifiedCamera(PlaneCamera):
    """A unified (UCM) or, with distortion, Mei camera: fisheyes and mirrors past 90°, as calibrated by ``cv2.omnidir``.

    See ``project_unified``; ``skew`` is the second number of OpenCV's matrix.

    Raises:
        ArgumentError: another number of coefficients.

    Examples:
        >>> camera = UnifiedCamera([400.0, 400.0], [319.5, 319.5], 1.2, [-0.1, 0.02, 1e-4, 0.0, 0.0], (640, 640))
        >>> camera.unproject(camera.project(torch.tensor([0.0, 0.96, -0.28])).pixels).directions
        tensor([ 0.0000,  0.9600, -0.2800])
    """

    model = "unified"
    functions = project_unified, unproject_unified

    xi: Intrinsic = Intrinsic(above=-1)
    distortion: OptionalIntrinsic = OptionalIntrinsic(4, 5, named="k1 k2 p1 p2 k3")
    image_size: ImageSize = ImageSize()
    max_angle: MaxAngle = MaxAngle(default=None)
    skew: OptionalIntrinsic = OptionalIntrinsic(default=None)

    def _check_intrinsics(self) -> None:
        if self.distortion is not None and self.distortion.shape[-1:] not in ((4,), (5,)):
            raise ArgumentError(
                "distortion: expected (*, 5) coefficients k1 k2 p1 p2 k3, (*, 4) without k3, or None, got shape "
                f"{tuple(self.distortion.shape)}"
            )
        super()._check_intrinsics()

    @torch.no_grad()
    def _model_end(self) -> Tensor:
        """Where the denominator vanishes, the radius turns or the distortion folds."""
        end = torch.acos(_widest_cosine(self.xi))
        if self.distortion is None:
            return end
        radius = fold_radius(self.distortion)
        direction, reached = _lift(radius, torch.zeros_like(radius), self.xi)
        return torch.where(reached, torch.atan2(direction[..., 0], direction[..., 2]), end)


fitted(
    UnifiedCamera,
    shape_grid((0.0, 0.25, 0.5, 0.75, 1.0, 1.3, 1.7, 2.2, 3.0)),
    num_coefficients=(4, 0, 5),
    bounds={"xi": (0.0, 50.0)},
)
