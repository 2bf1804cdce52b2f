# SPDX-License-Identifier: Apache-2.0
"""The pinhole camera with OpenCV's distortion: radial, tangential, rational, thin prism, tilted sensor."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.base import Projection, Unprojection
from sphericalvision.cameras.checks import model_function
from sphericalvision.cameras.declaration import ImageSize, Intrinsic, MaxAngle, OptionalIntrinsic
from sphericalvision.cameras.fitting import (
    PLANE_REACH,
    FittedModel,
    Samples,
    fitted,
    solve_linear,
    with_shapes,
)
from sphericalvision.cameras.models.image_plane import PlaneCamera, pixels_from_plane, plane_from_pixels
from sphericalvision.cameras.models.plane_distortion import (
    distort_inside,
    fold_radius,
    radius_limit,
    undistort,
)
from sphericalvision.cameras.registry import register_camera
from sphericalvision.core import ArgumentError
from sphericalvision.geometry.directions import components, unit_directions

NUMBERS_OF_COEFFICIENTS = (4, 5, 8, 12, 14)
NAMES = "k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 τx τy"
"""In OpenCV's order."""


def _check_distortion(distortion: Tensor) -> None:
    if distortion.ndim == 0 or distortion.shape[-1] not in NUMBERS_OF_COEFFICIENTS:
        raise ArgumentError(
            f"distortion: expected (*, 4), (*, 5), (*, 8), (*, 12) or (*, 14) coefficients in OpenCV's order {NAMES}, "
            f"got shape {tuple(distortion.shape)}; fill up with zeros"
        )


def _sensor_rotation(angles: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rows (*, 3) of OpenCV's rotation by the tilt angles (τx, τy) of the sensor."""
    cos_x, cos_y = torch.cos(angles).unbind(-1)
    sin_x, sin_y = torch.sin(angles).unbind(-1)
    return (
        torch.stack((cos_y, sin_y * sin_x, -sin_y * cos_x), -1),
        torch.stack((torch.zeros_like(cos_x), cos_x, sin_x), -1),
        torch.stack((sin_y, -cos_y * sin_x, cos_y * cos_x), -1),
    )


def _dot(row: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """``row`` (*, 3) times (x, y, 1)."""
    return row[..., 0] * x + row[..., 1] * y + row[..., 2]


def _tilt(u: Tensor, v: Tensor, angles: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Where the rays to (u, v) meet the tilted sensor, and whether they do."""
    first, second, third = _sensor_rotation(angles)
    depth = _dot(third, u, v)
    valid = depth > torch.finfo(u.dtype).eps
    depth = torch.where(valid, depth, 1.0)
    up, right, facing = second[..., 2], first[..., 2], third[..., 2]
    return facing * _dot(first, u, v) / depth - right, facing * _dot(second, u, v) / depth - up, valid


def _untilt(u: Tensor, v: Tensor, angles: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The inverse of ``_tilt``: a plane's image of a plane, by the transposed rotation."""
    first, second, third = _sensor_rotation(angles)
    facing = third[..., 2]
    a, b = (u + first[..., 2]) / facing, (v + second[..., 2]) / facing
    depth = _dot(torch.stack((first[..., 2], second[..., 2], facing), -1), a, b)
    valid = depth > torch.finfo(u.dtype).eps
    depth = torch.where(valid, depth, 1.0)
    x = first[..., 0] * a + second[..., 0] * b + third[..., 0]
    y = first[..., 1] * a + second[..., 1] * b + third[..., 1]
    return x / depth, y / depth, valid


@model_function
def project_brown_conrady(
    points: Float[Tensor, "*#batch 3"],
    focal_length: Float[Tensor, "*#batch 2"],
    principal_point: Float[Tensor, "*#batch 2"],
    distortion: Float[Tensor, "*#batch k"],
    max_tangent: Float[Tensor, "*#batch"] | None = None,
) -> Projection:
    """Pixels (*, 2) of ``points`` (*, 3) as ``cv2.projectPoints`` computes them.

    Valid in front of the camera, up to where the distortion stops being one-to-one: where the determinant of its
    Jacobian vanishes, or 89.994° from the axis.

    Args:
        points: (*, 3) in the camera's frame, any length.
        focal_length: (*, 2) in pixels.
        principal_point: (*, 2) as (u, v).
        distortion: (*, k) with k in 4, 5, 8, 12, 14, in OpenCV's order (k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4,
            τx, τy).
        max_tangent: (*), tangent of the angle from the axis up to which points are looked at; to it the radial
            distortion folds once at most. By default the largest such angle.

    Raises:
        ArgumentError: another number of coefficients.

    References:
        D. C. Brown, "Decentering distortion of lenses", Photogrammetric Engineering 32 (1966); OpenCV, "Camera
        calibration and 3D reconstruction", the equations of its detailed description.

    Examples:
        >>> lens = [torch.tensor(x) for x in ([100.0, 100.0], [320.0, 240.0], [-0.2, 0.0, 0.0, 0.0])]
        >>> project_brown_conrady(torch.tensor([1.0, 0.0, 2.0]), *lens).pixels
        tensor([367.5000, 240.0000])
    """
    _check_distortion(distortion)
    x, y, z = components(points)
    shrink = z.clamp_min(torch.finfo(z.dtype).tiny ** 0.4).reciprocal()
    u, v, valid = distort_inside(x * shrink, y * shrink, distortion, max_tangent)
    valid = valid & (z > 0)
    if distortion.shape[-1] == 14:
        u, v, meets = _tilt(u, v, distortion[..., 12:])
        valid = valid & meets
    return Projection(pixels_from_plane(u, v, focal_length, principal_point), valid)


@model_function
def unproject_brown_conrady(
    pixels: Float[Tensor, "*#batch 2"],
    focal_length: Float[Tensor, "*#batch 2"],
    principal_point: Float[Tensor, "*#batch 2"],
    distortion: Float[Tensor, "*#batch k"],
) -> Unprojection:
    """Unit directions (*, 3) of ``pixels`` (*, 2): the inverse of ``project_brown_conrady``, by Newton's method.

    Pixels that no direction within the one-to-one region maps to are not valid.

    Examples:
        >>> lens = [torch.tensor(x) for x in ([100.0, 100.0], [320.0, 240.0], [-0.2, 0.0, 0.0, 0.0])]
        >>> unproject_brown_conrady(torch.tensor([320.0, 240.0]), *lens).directions
        tensor([0., 0., 1.])
    """
    _check_distortion(distortion)
    u, v = plane_from_pixels(pixels, focal_length, principal_point)
    meets = None
    if distortion.shape[-1] == 14:
        u, v, meets = _untilt(u, v, distortion[..., 12:])
    x, y, valid = undistort(u, v, distortion)
    directions = unit_directions(x, y, torch.ones_like(x))
    return Unprojection(directions, valid if meets is None else valid & meets)


@register_camera
class BrownConradyCamera(PlaneCamera):
    """A pinhole camera with distortion, as calibrated by OpenCV, COLMAP, ROS and many others; up to 89.99°.

    See ``project_brown_conrady``; ``skew`` is Metashape's b2. The view ends at the latest between the first fold of the
    radial distortion and where it turns again, by default at the first fold.

    Raises:
        ArgumentError: another number of coefficients.

    Examples:
        >>> camera = BrownConradyCamera([500.0, 500.0], [319.5, 239.5], [-0.28, 0.07, 0.0, 0.0], (480, 640))
        >>> camera.unproject(camera.project(torch.tensor([0.0, 0.28, 0.96])).pixels).directions
        tensor([0.0000, 0.2800, 0.9600])
    """

    model = "brown_conrady"
    functions = project_brown_conrady, unproject_brown_conrady

    distortion: Intrinsic = Intrinsic(*NUMBERS_OF_COEFFICIENTS, named=NAMES)
    image_size: ImageSize = ImageSize()
    max_angle: MaxAngle = MaxAngle(default=None)
    skew: OptionalIntrinsic = OptionalIntrinsic(default=None)

    def _fill(self, values: dict[str, Any]) -> None:
        super()._fill(values)
        self._end_before_second_fold()

    def _check_intrinsics(self) -> None:
        _check_distortion(self.distortion)
        super()._check_intrinsics()

    def _model_end(self) -> Tensor:
        return torch.atan(fold_radius(self.distortion))

    def with_max_angle(self, max_angle: float | Float[Tensor, "*#batch"]) -> BrownConradyCamera:
        """The same camera with another limit of its field of view, in radians from the optical axis.

        At most between the first fold of the radial distortion and where it turns again.
        """
        changed = super().with_max_angle(max_angle)
        changed._end_before_second_fold()
        return changed

    def _end_before_second_fold(self) -> None:
        self.max_angle = torch.minimum(self.max_angle, torch.atan(radius_limit(self.distortion)))

    def _project(self, points: Tensor) -> Projection:
        arguments = [*self._arguments(points), torch.tan(self._widest(points))]
        pixels, valid = project_brown_conrady(points, *arguments)
        return Projection(self._skewed(pixels, 1), valid)

    def _within_max_angle(self, points: Tensor) -> Tensor:
        """Known from the radius in the plane: not asked for again."""
        return torch.ones((), dtype=torch.bool, device=points.device)


def _plane_start(model: FittedModel, samples: Samples) -> list[Tensor]:
    """Brown-Conrady: radius (1 + k4 r² + ...) = r (1 + k1 r² + ...) is linear, weighted by the last denominator."""
    size = model.sizes["distortion"] or 0
    r = samples.angle.tan()
    above = [r**3, r**5, r**7][: 2 if size == 4 else 3]
    below = [-samples.radius * r**power for power in (2, 4, 6)] if size >= 8 else []
    columns = torch.stack([*above, *below], dim=-1)
    weight = torch.ones_like(r)
    for _ in range(4 if below else 1):
        solution = solve_linear(columns * weight.unsqueeze(-1), (samples.radius - r) * weight)
        distortion = r.new_zeros(size)
        distortion[[0, 1, 4][: len(above)]] = solution[: len(above)]
        distortion[5 : 5 + len(below)] = solution[len(above) :]
        denominator = 1 + sum(
            (k * r**power for k, power in zip(solution[len(above) :], (2, 4, 6), strict=False)), 0 * r
        )
        weight = 1 / denominator.abs().clamp_min(1e-3)
    return with_shapes(model, samples, [distortion.tolist(), [0.0] * size])


fitted(BrownConradyCamera, _plane_start, num_coefficients=(8, 4, 5, 12, 14), reach=PLANE_REACH)
