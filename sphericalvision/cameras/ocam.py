# SPDX-License-Identifier: Apache-2.0
"""The omnidirectional polynomial model of Scaramuzza's OCamCalib toolbox.

Convention:
    ``principal_point`` is (u, v) as everywhere else; files say (row, column), and their reader swaps them once. The
    affine part (c, d, e) is the files': row = c·row' + d·col' + row_c, col = e·row' + col' + col_c, where (row', col')
    is the ideal image around its centre, row' along y and col' along x.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor

from sphericalvision.cameras.base import Camera, Projection, Unprojection
from sphericalvision.core import ArgumentError, check_last_dim
from sphericalvision.geometry import increasing_limit, normalize, polynomial, safe_hypot, solve_increasing

__all__ = ["OCamCamera", "project_ocam", "unproject_ocam"]


def _apply_affine(ideal: Tensor, affine: Tensor) -> Tensor:
    """Stretch and shear ideal offsets (*, 2), ordered (col', row')."""
    c, d, e = affine.unbind(-1)
    column, row = ideal.unbind(-1)
    return torch.stack((e * row + column, c * row + d * column), dim=-1)


def _undo_affine(offset: Tensor, affine: Tensor) -> Tensor:
    c, d, e = affine.unbind(-1)
    u, v = offset.unbind(-1)
    determinant = c - d * e
    return torch.stack(((c * u - e * v) / determinant, (v - d * u) / determinant), dim=-1)


def _scale_by_inverse_polynomial(points: Tensor, inverse_polynomial: Tensor) -> tuple[Tensor, Tensor]:
    """Image radius over ``hypot(x, y)`` from the polynomial in the angle from the image plane, and validity."""
    x, y, z = points.unbind(-1)
    radius = safe_hypot(x, y)
    on_axis = radius <= torch.finfo(points.dtype).eps * z.abs()
    angle = torch.atan2(-z, radius)
    image_radius, slope = polynomial(inverse_polynomial, angle)
    forward = torch.where(on_axis & (z > 0), z, 1.0)
    scale = torch.where(on_axis, slope / forward, image_radius / torch.where(on_axis, 1.0, radius))
    return scale, (slope > 0) & (image_radius > -1.0) & ~(on_axis & (z <= 0))


def _scale_by_root(points: Tensor, direct: Tensor, max_radius: Tensor) -> tuple[Tensor, Tensor]:
    """Image radius over ``hypot(x, y)`` such that the direct polynomial is met exactly, and validity.

    The image radius ρ is found from the angle ``atan2(ρ, −f(ρ))``, which is bounded; the scale k = ρ/r then solves
    ``k z + f(k r) = 0``, which is smooth on the axis too and carries the derivatives.
    """
    x, y, z = normalize(points).unbind(-1)
    radius = safe_hypot(x, y)
    with torch.no_grad():
        widest = increasing_limit(lambda rho: _angle_of_radius(direct.unsqueeze(-2), rho)[1], max_radius)
        solution = solve_increasing(
            lambda rho: _angle_of_radius(direct, rho),
            torch.atan2(radius, z),
            torch.zeros_like(widest),
            widest,
            start=-direct[..., 0] * radius,
        )
        near = (z > 0) & (radius < 1e-3 * z)  # here ρ/r would lose digits, and f(ρ) is all but constant
        scale = torch.where(
            near, -direct[..., 0] / torch.where(near, z, 1.0), solution.value / torch.where(near, 1.0, radius)
        )
        scale = torch.where(torch.isfinite(scale), scale, 0.0)
        valid = solution.converged & ~((radius == 0) & (z <= 0))
    for _ in range(3):
        value, slope = polynomial(direct, scale * radius)
        derivative = z + radius * slope
        usable = valid & (derivative > 0)
        step = (scale * z + value) / torch.where(usable, derivative, 1.0)
        scale = scale - torch.where(usable, step, 0.0)
    length = torch.linalg.vector_norm(points, dim=-1)
    return scale / torch.where(length > 0, length, 1.0), valid


def _angle_of_radius(direct: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
    """Angle from the axis of an image radius, and its derivative."""
    value, slope = polynomial(direct, radius)
    squared = radius * radius + value * value
    return torch.atan2(radius, -value), (radius * slope - value) / squared


def project_ocam(
    points: Tensor,
    direct_polynomial: Tensor,
    inverse_polynomial: Tensor | None,
    principal_point: Tensor,
    affine: Tensor,
    max_radius: Tensor | float = 1e4,
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
    check_last_dim("points", points, 3)
    if inverse_polynomial is None:
        scale, valid = _scale_by_root(points, direct_polynomial, torch.as_tensor(max_radius).to(points))
    else:
        scale, valid = _scale_by_inverse_polynomial(points, inverse_polynomial)
    ideal = points[..., :2] * scale.unsqueeze(-1)
    return Projection(_apply_affine(ideal, affine) + principal_point, valid)


def unproject_ocam(
    pixels: Tensor, direct_polynomial: Tensor, principal_point: Tensor, affine: Tensor
) -> Unprojection:
    """Unit directions (*, 3) of ``pixels`` (*, 2): (col', row', −f(ρ)) normalised, with ρ = hypot(col', row').

    Valid where larger radii still mean larger angles from the axis. The arguments are those of ``project_ocam``.

    Examples:
        >>> direct, center = torch.tensor([-100.0, 0.0, 0.0025]), torch.tensor([320.0, 240.0])
        >>> unproject_ocam(center, direct, center, torch.tensor([1.0, 0.0, 0.0])).directions
        tensor([0., 0., 1.])
    """
    check_last_dim("pixels", pixels, 2)
    ideal = _undo_affine(pixels - principal_point, affine)
    radius = safe_hypot(ideal[..., 0], ideal[..., 1])
    value, slope = polynomial(direct_polynomial, radius)
    directions = torch.cat((ideal, -value.unsqueeze(-1)), dim=-1)
    return Unprojection(normalize(directions), radius * slope - value > 0)


class OCamCamera(Camera):
    """A camera of the OCamCalib toolbox, with the inverse polynomial of its file or the exact inverse.

    With an inverse polynomial, ``project`` follows it, as other software does; it then agrees with ``unproject`` as
    well as the file's two polynomials agree with each other: in real files to between 0.01 and a few pixels.
    ``exact()`` gives the camera that inverts the direct polynomial instead.

    Args:
        polynomial: (*b, n) direct polynomial, ascending, first coefficient negative, of any degree.
        inverse_polynomial: (*b, m), ascending, or ``None`` for the exact inverse.
        principal_point: (*b, 2) as (u, v); files say (row, column).
        affine: (*b, 3) as (c, d, e).
        image_size: (height, width).
        max_angle: half the field of view in radians, a number or (*b,).

    Raises:
        ArgumentError: the first coefficient is not negative, or the affine part is singular.

    Examples:
        >>> identity = [1.0, 0.0, 0.0]
        >>> camera = OCamCamera([-100.0, 0.0, 0.0025], None, [320.0, 240.0], identity, (480, 640), max_angle=1.6)
        >>> camera.project(torch.tensor([0.0, 0.0, 2.0])).pixels.tolist()
        [320.0, 240.0]
    """

    model = "ocam"
    intrinsic_names: ClassVar[tuple[str, ...]] = (
        "polynomial",
        "inverse_polynomial",
        "principal_point",
        "affine",
    )

    polynomial: Tensor
    inverse_polynomial: Tensor | None
    principal_point: Tensor
    affine: Tensor

    def __init__(
        self,
        polynomial: Sequence[float] | Tensor,
        inverse_polynomial: Sequence[float] | Tensor | None,
        principal_point: Sequence[float] | Tensor,
        affine: Sequence[float] | Tensor,
        image_size: Sequence[int],
        max_angle: float | Tensor,
    ) -> None:
        super().__init__(
            image_size,
            max_angle,
            polynomial=polynomial,
            inverse_polynomial=inverse_polynomial,
            principal_point=principal_point,
            affine=affine,
        )
        check_last_dim("principal_point", self.principal_point, 2)
        check_last_dim("affine", self.affine, 3)
        c, d, e = self.affine.detach().unbind(-1)
        if not bool((self.polynomial.detach()[..., 0] < 0).all()):
            raise ArgumentError(
                "polynomial: the first coefficient of an OCam polynomial is negative (minus the focal length), "
                f"got {self.polynomial[..., 0].tolist()}; coefficients come in ascending order"
            )
        if bool((c - d * e == 0).any()):
            raise ArgumentError(f"affine: expected c − d·e ≠ 0, got (c, d, e) = {self.affine.tolist()}")
        self._set_batch(*self.principal_point.shape[:-1])

    def exact(self) -> OCamCamera:
        """This camera with the exact inverse of its direct polynomial in place of the inverse polynomial."""
        return OCamCamera(
            self.polynomial, None, self.principal_point, self.affine, self.image_size, self.max_angle
        )

    def _on_pixels(
        self, scale: tuple[float, float], offset: tuple[float, float], image_size: tuple[int, int]
    ) -> OCamCamera:
        """The ideal image is measured in pixels along u, so its radius ρ scales by s: f becomes s f(ρ / s)."""
        s, t = scale
        power = torch.arange(self.polynomial.shape[-1], dtype=self.dtype, device=self.device)
        return OCamCamera(
            self.polynomial * s ** (1 - power),
            None if self.inverse_polynomial is None else self.inverse_polynomial * s,
            self.principal_point * self.principal_point.new_tensor(scale)
            + self.principal_point.new_tensor(offset),
            self.affine * self.affine.new_tensor((t / s, t / s, 1.0)),
            image_size,
            self.max_angle,
        )

    def _max_radius(self, values: Tensor) -> Tensor:
        """An image radius (*) beyond the farthest corner, undistorted."""
        height, width = self.image_size
        u, v = self._align(self.principal_point, values).unbind(-1)
        corner = torch.hypot(torch.maximum(u, width - u), torch.maximum(v, height - v)).detach()
        return 1.25 * corner

    def _project(self, points: Tensor) -> Projection:
        direct, center, affine = (
            self._align(tensor, points) for tensor in (self.polynomial, self.principal_point, self.affine)
        )
        inverse = None if self.inverse_polynomial is None else self._align(self.inverse_polynomial, points)
        return project_ocam(points, direct, inverse, center, affine, self._max_radius(points))

    def _unproject(self, pixels: Tensor) -> Unprojection:
        tensors = (self.polynomial, self.principal_point, self.affine)
        return unproject_ocam(pixels, *(self._align(tensor, pixels) for tensor in tensors))
