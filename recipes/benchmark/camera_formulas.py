# SPDX-License-Identifier: Apache-2.0
"""Formulas of camera models as one would write them down: no checks, no validity, no care at the axis.

The benchmark measures the cameras against them. Each takes points (n, 3) or pixels (n, 2), the focal length ``f`` and
the principal point ``c`` as tensors (2,), and further parameters as numbers.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from sphericalvision.core import check_choice

__all__ = [
    "project_brown_conrady",
    "project_double_sphere",
    "project_equirectangular",
    "project_extended_unified",
    "project_fisheye",
    "project_kannala_brandt",
    "project_ocam",
    "project_pinhole",
    "project_radial_polynomial",
    "project_unified",
    "unproject_double_sphere",
    "unproject_equirectangular",
    "unproject_extended_unified",
    "unproject_fisheye",
    "unproject_ocam",
    "unproject_pinhole",
    "unproject_unified",
]


def _pixels(x: Tensor, y: Tensor, scale: Tensor | float, f: Tensor, c: Tensor) -> Tensor:
    return torch.stack((f[0] * x * scale + c[0], f[1] * y * scale + c[1]), -1)


def _plane(pixels: Tensor, f: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    u, v = pixels.unbind(-1)
    return (u - c[0]) / f[0], (v - c[1]) / f[1]


def _unit(x: Tensor, y: Tensor, z: Tensor | float) -> Tensor:
    length = torch.sqrt(x * x + y * y + z * z)
    return torch.stack((x / length, y / length, z / length), -1)


def _horner(coefficients: Any, x: Tensor) -> Tensor:
    """c0 + c1 x + c2 x² + ..."""
    value = torch.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = value * x + coefficient
    return value


def project_pinhole(points: Tensor, f: Tensor, c: Tensor, rest: Any) -> Tensor:
    """x / z."""
    return points[..., :2] / points[..., 2:] * f + c


def unproject_pinhole(pixels: Tensor, f: Tensor, c: Tensor, rest: Any) -> Tensor:
    """(x, y, 1)."""
    return _unit(*_plane(pixels, f, c), 1.0)


def project_brown_conrady(points: Tensor, f: Tensor, c: Tensor, rest: Any) -> Tensor:
    """Five coefficients."""
    k1, k2, p1, p2, k3 = rest
    x, y, z = points.unbind(-1)
    x, y = x / z, y / z
    r2 = x * x + y * y
    scale = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = x * scale + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * scale + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return _pixels(u, v, 1.0, f, c)


def project_kannala_brandt(points: Tensor, f: Tensor, c: Tensor, rest: Any) -> Tensor:
    """θ + k1 θ³ + ..."""
    x, y, z = points.unbind(-1)
    radius = torch.hypot(x, y)
    angle = torch.atan2(radius, z)
    return _pixels(x, y, angle * _horner((1.0, *rest), angle * angle) / radius, f, c)


def project_radial_polynomial(points: Tensor, f: Tensor, c: Tensor, rest: Any) -> Tensor:
    """k1 θ + k2 θ² + ... pixels."""
    x, y, z = points.unbind(-1)
    radius = torch.hypot(x, y)
    angle = torch.atan2(radius, z)
    scale = angle * _horner(rest, angle) / radius
    return torch.stack((x * scale + c[0], y * scale + c[1]), -1)


def project_unified(points: Tensor, f: Tensor, c: Tensor, rest: Any) -> Tensor:
    """x / (z + ξ |X|)."""
    x, y, z = points.unbind(-1)
    return _pixels(x, y, 1 / (z + rest[0] * torch.sqrt(x * x + y * y + z * z)), f, c)


def unproject_unified(pixels: Tensor, f: Tensor, c: Tensor, rest: Any) -> Tensor:
    """By the root of a quadratic."""
    (xi,) = rest
    x, y = _plane(pixels, f, c)
    r2 = x * x + y * y
    scale = (xi + torch.sqrt(1 + (1 - xi * xi) * r2)) / (1 + r2)
    return torch.stack((scale * x, scale * y, scale - xi), -1)


def project_extended_unified(points: Tensor, f: Tensor, c: Tensor, rest: Any) -> Tensor:
    """x / (α d + (1 − α) z)."""
    alpha, beta = rest
    x, y, z = points.unbind(-1)
    depth = torch.sqrt(beta * (x * x + y * y) + z * z)
    return _pixels(x, y, 1 / (alpha * depth + (1 - alpha) * z), f, c)


def unproject_extended_unified(pixels: Tensor, f: Tensor, c: Tensor, rest: Any) -> Tensor:
    """By the root of a quadratic."""
    alpha, beta = rest
    x, y = _plane(pixels, f, c)
    r2 = beta * (x * x + y * y)
    z = (1 - alpha * alpha * r2) / (alpha * torch.sqrt(1 - (2 * alpha - 1) * r2) + 1 - alpha)
    return _unit(x, y, z)


def project_double_sphere(points: Tensor, f: Tensor, c: Tensor, rest: Any) -> Tensor:
    """Two spheres and a pinhole."""
    xi, alpha = rest
    x, y, z = points.unbind(-1)
    r2 = x * x + y * y
    first = torch.sqrt(r2 + z * z)
    shifted = xi * first + z
    return _pixels(x, y, 1 / (alpha * torch.sqrt(r2 + shifted * shifted) + (1 - alpha) * shifted), f, c)


def unproject_double_sphere(pixels: Tensor, f: Tensor, c: Tensor, rest: Any) -> Tensor:
    """By the roots of two quadratics."""
    xi, alpha = rest
    x, y = _plane(pixels, f, c)
    r2 = x * x + y * y
    z = (1 - alpha * alpha * r2) / (alpha * torch.sqrt(1 - (2 * alpha - 1) * r2) + 1 - alpha)
    scale = (z * xi + torch.sqrt(z * z + (1 - xi * xi) * r2)) / (z * z + r2)
    return torch.stack((scale * x, scale * y, scale * z - xi), -1)


def project_ocam(points: Tensor, f: Tensor, c: Tensor, rest: Any) -> Tensor:
    """By the inverse polynomial."""
    _, inverse, (stretch, shear_v, shear_u) = rest
    x, y, z = points.unbind(-1)
    radius = torch.hypot(x, y)
    scale = _horner(inverse, torch.atan2(-z, radius)) / radius
    column, row = x * scale, y * scale
    return torch.stack((shear_u * row + column + c[0], stretch * row + shear_v * column + c[1]), -1)


def unproject_ocam(pixels: Tensor, f: Tensor, c: Tensor, rest: Any) -> Tensor:
    """By the direct polynomial."""
    direct, _, (stretch, shear_v, shear_u) = rest
    u, v = pixels.unbind(-1)
    u, v = u - c[0], v - c[1]
    determinant = stretch - shear_v * shear_u
    column, row = (stretch * u - shear_u * v) / determinant, (v - shear_v * u) / determinant
    return _unit(column, row, -_horner(direct, torch.hypot(column, row)))


def project_fisheye(points: Tensor, f: Tensor, c: Tensor, rest: Any) -> Tensor:
    """The image radius by the angle."""
    x, y, z = points.unbind(-1)
    radius = torch.hypot(x, y)
    angle = torch.atan2(radius, z)
    check_choice("projection", rest[0], ("equidistant", "equisolid", "stereographic", "orthographic"))
    if rest[0] == "equidistant":
        image = angle
    elif rest[0] == "orthographic":
        image = torch.sin(angle)
    else:
        image = 2 * (torch.sin if rest[0] == "equisolid" else torch.tan)(angle / 2)
    return _pixels(x, y, image / radius, f, c)


def unproject_fisheye(pixels: Tensor, f: Tensor, c: Tensor, rest: Any) -> Tensor:
    """The angle by the image radius."""
    x, y = _plane(pixels, f, c)
    radius = torch.hypot(x, y)
    if rest[0] == "equidistant":
        angle = radius
    elif rest[0] == "orthographic":
        angle = torch.asin(radius)
    else:
        angle = 2 * (torch.asin if rest[0] == "equisolid" else torch.atan)(radius / 2)
    scale = torch.sin(angle) / radius
    return torch.stack((x * scale, y * scale, torch.cos(angle)), -1)


def project_equirectangular(points: Tensor, f: Tensor, c: Tensor, rest: Any) -> Tensor:
    """Longitude and latitude."""
    height, width = rest
    x, y, z = points.unbind(-1)
    u = (torch.atan2(x, z) + math.pi) * (width / (2 * math.pi)) - 0.5
    v = (math.pi / 2 + torch.atan2(y, torch.hypot(x, z))) * (height / math.pi) - 0.5
    return torch.stack((u, v), -1)


def unproject_equirectangular(pixels: Tensor, f: Tensor, c: Tensor, rest: Any) -> Tensor:
    """By sines and cosines."""
    height, width = rest
    u, v = pixels.unbind(-1)
    longitude = (u + 0.5) * (2 * math.pi / width) - math.pi
    latitude = math.pi / 2 - (v + 0.5) * (math.pi / height)
    flat = torch.cos(latitude)
    return torch.stack((flat * torch.sin(longitude), -torch.sin(latitude), flat * torch.cos(longitude)), -1)
