# SPDX-License-Identifier: Apache-2.0
"""Cells of grids and cameras: directions spread over them, their widths and solid angles."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from sphericalvision.cameras import Camera, EquirectangularCamera
from sphericalvision.cameras.remapping.area import pixel_samples
from sphericalvision.core import ArgumentError
from sphericalvision.icosphere import Icosphere, icosphere_neighbors, icosphere_vertices
from sphericalvision.sphere.grids.sphere_grid import GridModule, SphereGrid


class CellSamples(NamedTuple):
    """Directions spread over each cell of a grid, in the order of its flattened values."""

    directions: Tensor
    """Unit vectors ``(n, s, 3)``."""
    shares: Tensor
    """Of the cell, ``(n, s)``; they sum to one."""
    valid: Tensor | None
    """Whether a camera looks there, bool ``(n, s)``; None for a grid, which covers the sphere."""


def grid_shape(grid: SphereGrid | Camera, name: str) -> tuple[int, ...]:
    """Shape of values on a grid or of a camera's image."""
    if isinstance(grid, Camera):
        if grid.batch_shape:
            raise ArgumentError(
                f"{name}: expected a single camera, got a batch of shape {grid.batch_shape}; "
                "take one with Camera.select"
            )
        return grid.image_size
    # The protocol's check reads each property of a grid, solid angles among them.
    if not isinstance(grid, GridModule | Icosphere | SphereGrid):
        raise ArgumentError(
            f"{name}: expected a SphereGrid (Icosphere, Equirectangular, Cubemap, Healpix, TangentImages) or a Camera, "
            f"got {type(grid).__name__}"
        )
    return tuple(grid.shape)


def cell_samples(
    grid: SphereGrid | Camera,
    samples: int | tuple[int, int],
    dtype: torch.dtype,
    device: torch.device,
    cells: Int[Tensor, " n"] | None = None,
) -> CellSamples:
    """``samples`` directions along each side of every cell; for one, the grid's own directions.

    Computed in the precision asked for; the grid's own directions are not computed again if they have it.

    Args:
        grid: grid or camera.
        samples: along both sides; of a camera's pixels along u and along v, of other cells the larger counts.
        dtype: of the answer.
        device: of the answer.
        cells: flat indices of the cells; all if not given.
    """
    sides = (samples, samples) if isinstance(samples, int) else samples
    if isinstance(grid, Camera):
        if cells is None:
            cells = torch.arange(math.prod(grid.image_size), device=device)
        directions, valid = grid.unproject(pixel_samples(grid, cells, sides, dtype))
        return CellSamples(
            directions, torch.full_like(directions[..., 0], 1 / math.prod(sides)).detach(), valid
        )
    if isinstance(grid, Icosphere):
        directions, weights = _vertex_samples(grid.level, max(sides), dtype, device, cells)
        return CellSamples(directions, weights, None)
    made = sides == (1, 1) and dtype == grid.directions.dtype
    if hasattr(grid, "cell_samples") and not made:
        directions, weights = grid.cell_samples(max(sides), dtype, device)
    elif max(sides) > 1:
        raise ArgumentError(
            f"target: mode 'area' needs a method cell_samples(samples, dtype, device), which {type(grid).__name__} "
            "lacks; see Equirectangular.cell_samples"
        )
    else:
        directions = grid.directions.reshape(-1, 1, 3).to(device=device, dtype=dtype)
        weights = torch.ones_like(directions[..., 0])
    if cells is not None:
        directions, weights = directions[cells], weights.expand(directions.shape[:-1])[cells]
    return CellSamples(directions, weights, None)


def cell_widths(grid: SphereGrid | Camera) -> Float[Tensor, " n"]:
    """How wide each cell is, in radians ``(n,)``: the square root of its solid angle.

    Rows of a panorama hold more pixels near the poles than content, so there a width at the equator counts.
    """
    if isinstance(grid, EquirectangularCamera):
        height, width = grid.image_size
        pixel = grid.vertical_field_of_view / height * (grid.longitudes[1] - grid.longitudes[0]) / width
        return grid.max_angle.new_full((height * width,), math.sqrt(pixel))
    if isinstance(grid, Camera):
        return pixel_solid_angles(grid).sqrt()
    widths = getattr(grid, "cell_widths", None)
    return (grid.solid_angles.sqrt() if widths is None else widths).flatten()


def pixel_solid_angles(camera: Camera) -> Float[Tensor, " n"]:
    """Solid angle of each pixel of a camera's image in steradians ``(n,)``, also where the camera does not look."""
    corners = cell_samples(camera, 2, torch.float64, camera.device).directions.detach()
    across, down = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return 4 * torch.linalg.cross(across, down).norm(dim=-1)


def _vertex_samples(
    level: int, samples: int, dtype: torch.dtype, device: torch.device, cells: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Samples over six (five) kites around each vertex: between it, two edge midpoints and a face's middle."""
    center = icosphere_vertices(level, torch.float64, device)
    neighbors = icosphere_neighbors(level, device)
    own = center
    if cells is not None:
        own, neighbors = center[cells], neighbors[cells]
    if samples == 1:
        return own.unsqueeze(1).to(dtype), own.new_ones(len(own), 1, dtype=dtype)
    following = neighbors.roll(-1, 1)
    five = neighbors[:, 5] < 0
    following[five, 4] = neighbors[five, 0]
    a, b, o = center[neighbors], center[following], own.unsqueeze(1)  # entry -1 has no share, see below
    corners = (o.expand_as(a), (o + a) / 2, (o + a + b) / 3, (o + b) / 2)
    count = -(-samples // 2)
    side = (torch.arange(count, dtype=torch.float64, device=device) + 0.5) / count
    s, t = side.repeat(count)[:, None], side.repeat_interleave(count)[:, None]
    p, q, r, u = (corner.unsqueeze(2) for corner in corners)
    points = (1 - s) * (1 - t) * p + s * (1 - t) * q + s * t * r + (1 - s) * t * u
    along_s = (1 - t) * (q - p) + t * (r - u)
    along_t = (1 - s) * (u - p) + s * (r - q)
    volume = (points * torch.linalg.cross(along_s, along_t, dim=-1)).sum(-1).abs()
    weights = volume / points.norm(dim=-1) ** 3
    weights[five, 5] = 0
    weights = weights.flatten(1)
    weights = weights / weights.sum(-1, keepdim=True)
    return F.normalize(points, dim=-1).flatten(1, 2).to(dtype), weights.to(dtype)
