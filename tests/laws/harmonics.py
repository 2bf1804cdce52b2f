# SPDX-License-Identifier: Apache-2.0
"""Real spherical harmonics up to degree three, in closed form: functions that know no seam and no pole."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def harmonics(directions: Tensor) -> Tensor:
    """All sixteen, orthonormal on the sphere, ``(16, *)`` at unit directions ``(*, 3)``.

    Polynomials as in the usual tables (e.g. Sloan, "Stupid spherical harmonics tricks", 2008), signs left away.
    """
    x, y, z = directions.unbind(-1)
    a, b, c = (math.sqrt(k / math.pi) for k in (1 / 4, 3 / 4, 15 / 4))
    d, e = math.sqrt(5 / (16 * math.pi)), math.sqrt(15 / (16 * math.pi))
    f, g, h = (math.sqrt(k / (32 * math.pi)) for k in (35, 21, 210))
    i, j = math.sqrt(105 / (4 * math.pi)), math.sqrt(7 / (16 * math.pi))
    return torch.stack(
        (
            torch.full_like(x, a),
            *(b * x, b * y, b * z),
            *(c * x * y, c * y * z, d * (3 * z * z - 1), c * x * z, e * (x * x - y * y)),
            *(f * y * (3 * x * x - y * y), i * x * y * z, g * y * (5 * z * z - 1)),
            *(j * (5 * z**3 - 3 * z), g * x * (5 * z * z - 1)),
            *(h * z * (x * x - y * y), f * x * (x * x - 3 * y * y)),
        )
    )
