# SPDX-License-Identifier: Apache-2.0
"""The omnidirectional polynomial model of Scaramuzza's OCamCalib toolbox.

Convention:
    ``principal_point`` is (u, v) as everywhere else; files say (row, column), and their reader swaps them once. The
    affine part (c, d, e) is the files': row = c·row' + d·col' + row_c, col = e·row' + col' + col_c, where (row', col')
    is the ideal image around its centre, row' along y and col' along x.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.base import Camera, Projection, Unprojection
from sphericalvision.cameras.checks import model_function
from sphericalvision.cameras.declaration import ANY, ImageSize, Intrinsic, MaxAngle, OptionalIntrinsic
from sphericalvision.cameras.fitting import FittedModel, Samples, fitted, solve_linear
from sphericalvision.cameras.registry import register_camera
from sphericalvision.core import ArgumentError
from sphericalvision.geometry import normalize
from sphericalvision.geometry.directions import components, from_components, holds, lifted_radius
from sphericalvision.geometry.rootfinding import (
    InverseTable,
    increasing_limit,
    polynomial,
    polynomial_with_curvature,
    refine_root,
    samples_towards,
    tabulate_inverse,
)


def _undo_affine(pixels: Tensor, principal_point: Tensor, affine: Tensor) -> tuple[Tensor, Tensor]:
    """The ideal image's offsets col' and row' from its centre, each (*)."""
    (u, v), (cu, cv) = components(pixels), principal_point.unbind(-1)
    c, d, e = affine.unbind(-1)
    u, v = u - cu, v - cv
    determinant = c - d * e
    return (c * u - e * v) / determinant, (v - d * u) / determinant


def _scale_by_inverse_polynomial(
    x: Tensor, y: Tensor, z: Tensor, inverse_polynomial: Tensor
) -> tuple[Tensor, Tensor]:
    """Image radius over ``hypot(x, y)`` from the polynomial in the angle from the image plane, and validity.

    On the axis it is the polynomial's slope over z, whatever radius the polynomial leaves there.
    """
    limits = torch.finfo(z.dtype)
    depth = z.abs() + limits.tiny**0.45
    squared = torch.addcmul(x * x, y, y)
    least = (limits.eps * depth).square()
    on_axis = squared <= least
    radius = (squared + least + limits.tiny**0.55).sqrt()
    image_radius, slope = polynomial(inverse_polynomial, torch.atan2(-z, radius))
    scale = torch.where(on_axis, slope / depth, image_radius / radius)
    return scale, (slope > 0) & (image_radius > -1.0) & ~(on_axis & (z <= 0))


def _angle_of_radius(direct: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
    """Angle from the axis of an image radius, and a multiple of its derivative."""
    value, slope = polynomial(direct, radius)
    return torch.atan2(radius, -value), radius * slope - value


def _inverse_table(direct: Tensor, max_radius: Tensor) -> InverseTable:
    """Image radius over sin θ for angles θ from the axis, up to where larger radii no longer mean larger angles."""
    with torch.no_grad():
        direct = direct.unsqueeze(-2)
        widest = increasing_limit(lambda rho: _angle_of_radius(direct, rho)[1], max_radius, samples=256)
        radius = samples_towards(widest)[..., 1:]
        angle, _ = _angle_of_radius(direct, radius)
        slope = radius / torch.sin(angle)
        on_axis = -direct[..., 0].expand(slope[..., :1].shape)
        return tabulate_inverse(
            torch.cat((on_axis, slope), dim=-1), torch.cat((torch.zeros_like(on_axis), angle), dim=-1)
        )


def _scale_by_root(
    x: Tensor, y: Tensor, z: Tensor, direct: Tensor, max_radius: Tensor
) -> tuple[Tensor, Tensor]:
    """Image radius over ``hypot(x, y)`` such that the direct polynomial is met exactly, and validity.

    The scale k of a unit direction (r, z) solves k z + f(k r) = 0, which is smooth on the axis too.
    """
    radius = lifted_radius(x, y, z)
    shrink = torch.addcmul(radius * radius, z, z).rsqrt()
    r, along = radius * shrink, z * shrink
    table = _inverse_table(direct, max_radius)
    angle = torch.atan2(radius.detach(), z.detach())
    inside = angle <= table.limit * (1 + 16 * torch.finfo(angle.dtype).eps)

    def miss(scale: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        value, slope, curvature = polynomial_with_curvature(direct, scale * r)
        return torch.addcmul(value, scale, along), torch.addcmul(along, r, slope), r * r * curvature

    start = table.lookup(angle)
    scale, converged = refine_root(miss, torch.zeros_like(start), start, 2 * start)
    return scale * shrink, inside & converged


@model_function
def project_ocam(
    points: Float[Tensor, "*#batch 3"],
    direct_polynomial: Float[Tensor, "*#batch k"],
    inverse_polynomial: Float[Tensor, "*#batch m"] | None,
    principal_point: Float[Tensor, "*#batch 2"],
    affine: Float[Tensor, "*#batch 3"],
    max_radius: Float[Tensor, "*#batch"] | float = 1e4,
) -> Projection:
    """Pixels (*, 2) of ``points`` (*, 3) through an OCam lens.

    Args:
        points: (*, 3) in the camera's frame, any length.
        direct_polynomial: (*, n) ascending coefficients a0, a1, ... with a0 < 0, see ``unproject_ocam``. Of any degree.
        inverse_polynomial: (*, m) ascending coefficients of the image radius in pixels as a function of the angle from
            the image plane, ``atan2(−z, hypot(x, y))``. ``None`` inverts the direct polynomial exactly instead.
        principal_point: (*, 2) as (u, v).
        affine: (*, 3) as (c, d, e).
        max_radius: (*), largest image radius in pixels looked at by the exact inverse.

    References:
        D. Scaramuzza, A. Martinelli, R. Siegwart, "A toolbox for easily calibrating omnidirectional
        cameras", IROS 2006.

    Examples:
        >>> forward, right = torch.eye(3)[2], torch.eye(3)[0]
        >>> direct, center = torch.tensor([-100.0, 0.0, 0.0025]), torch.tensor([320.0, 240.0])
        >>> project_ocam(torch.stack((forward, right)), direct, None, center, torch.tensor([1.0, 0.0, 0.0])).pixels
        tensor([[320., 240.],
                [520., 240.]])
    """
    x, y, z = components(points)
    if inverse_polynomial is None:
        scale, valid = _scale_by_root(x, y, z, direct_polynomial, torch.as_tensor(max_radius).to(points))
    else:
        scale, valid = _scale_by_inverse_polynomial(x, y, z, inverse_polynomial)
    column, row = x * scale, y * scale
    c, d, e = affine.unbind(-1)
    cu, cv = principal_point.unbind(-1)
    return Projection(from_components(e * row + column + cu, c * row + d * column + cv), valid)


@model_function
def unproject_ocam(
    pixels: Float[Tensor, "*#batch 2"],
    direct_polynomial: Float[Tensor, "*#batch k"],
    principal_point: Float[Tensor, "*#batch 2"],
    affine: Float[Tensor, "*#batch 3"],
) -> Unprojection:
    """Unit directions (*, 3) of ``pixels`` (*, 2): (col', row', −f(ρ)) normalised, with ρ = hypot(col', row').

    Valid where larger radii still mean larger angles from the axis. The arguments are those of ``project_ocam``.

    Examples:
        >>> direct, center = torch.tensor([-100.0, 0.0, 0.0025]), torch.tensor([320.0, 240.0])
        >>> unproject_ocam(center, direct, center, torch.tensor([1.0, 0.0, 0.0])).directions
        tensor([0., 0., 1.])
    """
    column, row = _undo_affine(pixels, principal_point, affine)
    squared = torch.addcmul(column * column, row, row)
    radius = (squared + torch.finfo(squared.dtype).tiny).sqrt()
    value, slope = polynomial(direct_polynomial, radius)
    directions = normalize(from_components(column, row, -value))
    return Unprojection(directions, radius * slope - value > 0)


@register_camera
class OCamCamera(Camera):
    """A camera of the OCamCalib toolbox, with the inverse polynomial of its file or the exact inverse.

    With an inverse polynomial, ``project`` follows it, as other software does; it then agrees with ``unproject`` as
    well as the file's two polynomials agree with each other: in real files to between 0.01 and a few pixels.
    ``exact()`` gives the camera that inverts the direct polynomial instead.

    See ``project_ocam`` and ``unproject_ocam``, whose direct polynomial is ``polynomial``. By default the view ends a
    little beyond the angle at the farthest corner of the image, or before where the angle stops growing.

    Raises:
        ArgumentError: the first coefficient is not negative, or the affine part is singular.

    Examples:
        >>> identity = [1.0, 0.0, 0.0]
        >>> camera = OCamCamera([-100.0, 0.0, 0.0025], None, [320.0, 240.0], identity, (480, 640), max_angle=1.6)
        >>> camera.project(torch.tensor([0.0, 0.0, 2.0])).pixels.tolist()
        [320.0, 240.0]
    """

    model = "ocam"

    polynomial: Intrinsic = Intrinsic(ANY)
    inverse_polynomial: OptionalIntrinsic = OptionalIntrinsic(ANY)
    principal_point: Intrinsic = Intrinsic(2)
    affine: Intrinsic = Intrinsic(3)
    image_size: ImageSize = ImageSize()
    max_angle: MaxAngle = MaxAngle(default=None)

    def _check_intrinsics(self) -> None:
        super()._check_intrinsics()
        c, d, e = self.affine.detach().unbind(-1)
        if not holds(self.polynomial.detach()[..., 0] < 0):
            raise ArgumentError(
                "polynomial: the first coefficient of an OCam polynomial is negative (minus the focal length), "
                f"got {self.polynomial[..., 0].tolist()}; coefficients come in ascending order"
            )
        if not holds(c - d * e != 0):
            raise ArgumentError(f"affine: expected c − d·e ≠ 0, got (c, d, e) = {self.affine.tolist()}")

    def _model_end(self) -> Tensor:
        return _inverse_table(self.polynomial.detach(), self._max_radius(self.polynomial)).limit

    def exact(self) -> OCamCamera:
        """This camera with the exact inverse of its direct polynomial in place of the inverse polynomial."""
        return self._with_inverse(None)

    def _with_inverse(self, inverse: Tensor | None) -> OCamCamera:
        return OCamCamera(
            self.polynomial, inverse, self.principal_point, self.affine, self.image_size, self.max_angle
        )

    def _scaled(self, scale: tuple[float, float]) -> dict[str, Tensor]:
        """The ideal image is measured in pixels along u, so its radius ρ scales by s: f becomes s f(ρ / s)."""
        s, t = scale
        power = torch.arange(self.polynomial.shape[-1], dtype=self.dtype, device=self.device)
        inverse = (
            {} if self.inverse_polynomial is None else {"inverse_polynomial": self.inverse_polynomial * s}
        )
        affine = self.affine * self.affine.new_tensor((t / s, t / s, 1.0))
        return {"polynomial": self.polynomial * s ** (1 - power), "affine": affine} | inverse

    def _max_radius(self, values: Tensor) -> Tensor:
        """An image radius (*) beyond the farthest corner, undistorted."""
        height, width = self.image_size
        center, affine = (self._align(x, values).detach() for x in (self.principal_point, self.affine))
        corners = center.new_tensor([[0, 0], [width, 0], [0, height], [width, height]])
        offsets = _undo_affine(corners, center.unsqueeze(-2), affine.unsqueeze(-2))
        return 1.25 * torch.hypot(*offsets).amax(-1)

    def _project(self, points: Tensor) -> Projection:
        return project_ocam(points, *[*self._aligned(points), self._max_radius(points)])

    def _unproject(self, pixels: Tensor) -> Unprojection:
        direct, _, center, affine = self._aligned(pixels)
        return unproject_ocam(pixels, direct, center, affine)


_ROUNDS = 5


def _ocam_start(model: FittedModel, samples: Samples) -> list[Tensor]:
    """OCam: affine map and inverse polynomial, in turns: either follows linearly from the other."""
    theta = samples.angle - math.pi / 2
    powers = torch.stack([theta**power for power in range(model.sizes["inverse_polynomial"] or 0)], dim=-1)
    around = torch.nn.functional.normalize(samples.directions[:, :2], dim=-1)
    aspect = samples.focal_length[1] / samples.focal_length[0]
    affine = torch.stack((aspect, 0 * aspect, 0 * aspect))
    for _ in range(_ROUNDS):
        radius = torch.hypot(*_undo_affine(samples.pixels, samples.center, affine))
        coefficients = solve_linear(powers, radius)
        ideal = (powers @ coefficients).unsqueeze(-1) * around
        offsets = (samples.pixels - samples.center).unbind(-1)
        (across, e), (d, down) = (solve_linear(ideal, offset) for offset in offsets)
        affine = torch.stack((down, d, e)) / across
    intrinsics = {"inverse_polynomial": coefficients, "principal_point": samples.center, "affine": affine}
    return [model.vector(intrinsics)]


def _project_inverse(
    directions: Tensor, inverse_polynomial: Tensor, principal_point: Tensor, affine: Tensor
) -> Projection:
    return project_ocam(directions, inverse_polynomial[:1], inverse_polynomial, principal_point, affine)


def _before_direct_fit(intrinsics: dict[str, Any]) -> dict[str, Any]:
    """A direct polynomial that stands there until it is fitted to the inverse one."""
    return intrinsics | {"polynomial": -intrinsics["inverse_polynomial"].new_ones(1)}


fitted(
    OCamCamera,
    _ocam_start,
    num_coefficients=(12, *range(2, 12), *range(13, 19)),
    left_out=("polynomial",),
    project=_project_inverse,
    complete=_before_direct_fit,
)
