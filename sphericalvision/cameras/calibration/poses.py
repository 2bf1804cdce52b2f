# SPDX-License-Identifier: Apache-2.0
"""Rigid transforms as files hold them: matrices, quaternions, rotation vectors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.calibration.parsing import numbers
from sphericalvision.core import FileFormatError
from sphericalvision.geometry import transform_from_axis_angle, transform_from_quaternion

OPENGL_FROM_OPENCV = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
"""From x right, y down, z forward to x right, y up, z backward, and back."""


def checked_rigid(transform: Float[Tensor, "4 4"], where: str) -> Float[Tensor, "4 4"]:
    """``transform`` (4, 4) if its rotation is one to three digits, else ``FileFormatError``."""
    rotation = transform[:3, :3]
    deviation = float((rotation @ rotation.mT - torch.eye(3, dtype=rotation.dtype)).abs().max())
    if not (deviation < 1e-3 and float(torch.linalg.det(rotation)) > 0):
        fault = f"one that is off by {deviation:.2g}"
        if deviation < 1e-3:
            fault = "a mirror (determinant -1): axes are left-handed; negate one of them in poses and points"
        raise FileFormatError(
            f"{where}: expected a rotation (orthonormal, determinant +1) in the upper left 3 x 3, got {fault}"
        )
    return transform


def checked_radians(rotation: Sequence[float], where: str) -> Sequence[float]:
    """``rotation``, a rotation vector, if it is no longer than a full turn, else ``FileFormatError``."""
    if (angle := math.hypot(*rotation)) > 2 * math.pi:
        raise FileFormatError(
            f"{where}: expected a rotation vector in radians, got one of length {angle:.4g}; are these degrees?"
        )
    return rotation


def transform_from_rows(values: Any, where: str) -> Float[Tensor, "4 4"]:
    """A rigid transform (4, 4), float64, from 4 or 3 rows of 4 numbers, nested or one after the other.

    Examples:
        >>> transform_from_rows([1, 0, 0, 0.5, 0, 1, 0, 0, 0, 0, 1, 0], "here")[0, 3].item()
        0.5
    """
    nested = isinstance(values, list) and any(isinstance(row, list) for row in values)
    if nested:
        rows = [numbers(row, f"{where}, row {index}", 4) for index, row in enumerate(values)]
        flat = [value for row in rows for value in row]
    else:
        flat = numbers(values, where)
    if len(flat) not in (12, 16):
        raise FileFormatError(f"{where}: expected 4 rows of 4 numbers, got {len(flat)} numbers")
    if len(flat) == 16 and flat[12:] != [0.0, 0.0, 0.0, 1.0]:
        raise FileFormatError(f"{where}: expected 0 0 0 1 in the last row, got {flat[12:]}")
    last = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)
    upper = torch.tensor(flat[:12], dtype=torch.float64).reshape(3, 4)
    return checked_rigid(torch.cat((upper, last)), where)


def transform_from_rotation(
    rotation: Sequence[float], translation: Sequence[float], where: str
) -> Float[Tensor, "4 4"]:
    """A rigid transform (4, 4), float64, of the 9 numbers of a rotation, row by row, and a translation.

    Examples:
        >>> transform_from_rotation([1, 0, 0, 0, 1, 0, 0, 0, 1], [0.5, 0, 0], "here")[0, 3].item()
        0.5
    """
    rows = [[*rotation[3 * row : 3 * row + 3], *translation[row : row + 1]] for row in range(3)]
    return transform_from_rows(rows, where)


def transform_from_numbers(
    quaternion: Sequence[float], translation: Sequence[float], where: str
) -> Float[Tensor, "4 4"]:
    """A rigid transform (4, 4), float64, of (w, x, y, z) and a translation.

    Examples:
        >>> transform_from_numbers([1, 0, 0, 0], [0.5, 0, 0], "here")[0, 3].item()
        0.5
    """
    if not 0.99 < (length := math.hypot(*quaternion)) < 1.01:
        raise FileFormatError(f"{where}: expected a quaternion of length 1, got one of length {length:.3g}")
    table = torch.tensor([*quaternion, *translation], dtype=torch.float64)
    return transform_from_quaternion(table[:4], table[4:])


def transform_from_rotation_vector(
    rotation: Sequence[float], translation: Sequence[float], where: str
) -> Float[Tensor, "4 4"]:
    """A rigid transform (4, 4), float64, of a rotation vector in radians and a translation.

    Examples:
        >>> transform_from_rotation_vector([0, 0, 0], [0.5, 0, 0], "here")[0, 3].item()
        0.5
    """
    table = torch.tensor([*checked_radians(rotation, where), *translation], dtype=torch.float64)
    return transform_from_axis_angle(table[:3], table[3:])


def quaternion_from_rotation(rotation: Float[Tensor, "3 3"]) -> list[float]:
    """(w, x, y, z) with w >= 0 of a rotation (3, 3), to the last digits for every angle.

    Examples:
        >>> quaternion_from_rotation(torch.eye(3))
        [1.0, 0.0, 0.0, 0.0]
    """
    x, y, z, w = _scipy_rotation(rotation).as_quat(canonical=True).tolist()
    return [w, x, y, z]


def axis_angle_from_rotation(rotation: Float[Tensor, "3 3"]) -> list[float]:
    """The rotation vector in radians of a rotation (3, 3), to the last digits for every angle.

    Examples:
        >>> axis_angle_from_rotation(torch.eye(3))
        [0.0, 0.0, 0.0]
    """
    vector: list[float] = _scipy_rotation(rotation).as_rotvec().tolist()
    return vector


def _scipy_rotation(rotation: Float[Tensor, "3 3"]) -> Any:
    from scipy.spatial.transform import Rotation  # half a second to import

    return Rotation.from_matrix(rotation.detach().to("cpu", torch.float64).numpy())
