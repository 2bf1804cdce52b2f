# SPDX-License-Identifier: Apache-2.0
"""What grids of one size lose, at their seams and elsewhere, and how long reading them takes."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from sphericalvision.geometry import longitude_latitude_from_directions
from sphericalvision.icosphere import Icosphere
from sphericalvision.recipes.evaluation.tables import Row, Table
from sphericalvision.sphere import (
    Cubemap,
    Equirectangular,
    Healpix,
    Resample,
    TangentImages,
)

__all__ = ["comparison"]

GRIDS: dict[str, Callable[..., Any]] = {
    "Equirectangular": lambda **kwargs: Equirectangular(72, 144, **kwargs),
    "Cubemap": lambda **kwargs: Cubemap(42, **kwargs),
    "Healpix": lambda **kwargs: Healpix(29, **kwargs),
    "Icosphere": lambda **kwargs: Icosphere(5, **kwargs),
    "TangentImages": lambda **kwargs: TangentImages(0, 23, **kwargs),
}
"""Ten thousand values each."""
SEAM = math.radians(2.5)
"""Half the width of what counts as a seam."""
ROUNDS = 15


def harmonics(directions: Tensor) -> Tensor:
    """Spherical harmonics up to degree three, not normalised: ``(16, n)``."""
    x, y, z = directions.unbind(-1)
    low = [x * 0 + 1, x, y, z, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y]
    cubic = [
        y * (3 * x * x - y * y),
        x * y * z,
        y * (5 * z * z - 1),
        z * (5 * z * z - 3),
        x * (5 * z * z - 1),
        z * (x * x - y * y),
        x * (x * x - 3 * y * y),
    ]
    return torch.stack(low + cubic)


def at_seams(name: str, directions: Tensor) -> Tensor:
    """Which directions lie within a few degrees of a seam: ``(n,)``."""
    longitude, latitude = longitude_latitude_from_directions(directions)
    if name in ("Equirectangular", "Healpix"):
        poles = latitude.abs() > math.pi / 2 - SEAM
        return (longitude.abs() > math.pi - SEAM) | poles
    if name == "Cubemap":
        return directions.abs().sort(-1).values.diff(dim=-1)[:, 1] < SEAM
    corners = Icosphere(0, dtype=torch.float64)
    return corners.locate(directions)[1].amin(-1) < SEAM


def interpolated(grid: Any, values: Tensor, directions: Tensor) -> Tensor:
    """Values at directions, as ``resample`` reads them: of HEALPix with weights for chords."""
    if isinstance(grid, Healpix):
        ids, weights = grid.taps(directions)
        return (values[:, ids] * weights).sum(-1)
    return grid.sample(values, directions)


def time_ratio(
    function: Callable[[], object], other: Callable[[], object]
) -> float:
    """How much longer the first takes: a median of turns, both slowed alike."""
    ratios = []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        function()
        between = time.perf_counter()
        other()
        ratios.append((between - start) / (time.perf_counter() - between))
    return statistics.median(ratios)


def comparison() -> str:
    """One row a grid."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(40_000, 3, dtype=torch.float64, generator=generator)
    directions = F.normalize(noise, dim=-1)
    target = Equirectangular(128, 256)
    image, pixels = torch.rand(1, 16, 128, 256), torch.rand(1, 128, 256, 2) * 2 - 1
    rows: list[Row] = []
    for name, make in GRIDS.items():
        exact, grid = make(dtype=torch.float64), make()
        # Of tangent images whole pixels count: a face may cut off any part of one.
        areas = (
            exact.cell_widths**2 if name == "TangentImages" else exact.solid_angles
        )
        values = interpolated(exact, harmonics(exact.directions), directions)
        error = (values - harmonics(directions)).abs().amax(0)
        seams = at_seams(name, directions)
        read, content = Resample(grid, target), torch.rand(1, 16, *grid.shape)
        ratio = time_ratio(
            lambda read=read, content=content: read(content),  # type: ignore[misc]
            lambda: F.grid_sample(image, pixels, align_corners=False),
        )
        rows.append(
            [
                f"{name}{exact.shape}",
                f"{math.prod(grid.shape):,}",
                f"{areas.max() / areas.min():.2f}",
                f"{error[seams].max():.4f}",
                f"{error[~seams].max():.4f}",
                f"{ratio:.1f}",
            ]
        )
    columns = "grid|values|solid angle, largest / smallest|error at seams|error elsewhere|time"
    return Table("", tuple(columns.split("|")), rows).markdown()
