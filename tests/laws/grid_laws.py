# SPDX-License-Identifier: Apache-2.0
"""The table of grids: one entry holds all that the laws need to know of a grid.

A new grid is one line in ``GRIDS`` and gets every law. An entry says where the grid's interpolation could go wrong and
which rotations map the grid onto itself; neither has a default, so that no grid is taken for another.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from sphericalvision.geometry import longitude_latitude_from_directions
from sphericalvision.icosphere import Icosphere
from sphericalvision.sphere import Cubemap, Equirectangular, Healpix, SphereGrid, TangentImages

DOUBLE = torch.float64
UP, AHEAD = torch.tensor([0.0, -1, 0], dtype=DOUBLE), torch.tensor([0.0, 0, 1], dtype=DOUBLE)


def spread_directions(count: int) -> Tensor:
    """Directions ``(count, 3)`` all over the sphere, each for the same area: a Fibonacci lattice."""
    number = torch.arange(count, dtype=DOUBLE) + 0.5
    y = 1 - 2 * number / count
    turn = number * (math.pi * (1 + math.sqrt(5)))
    radius = (1 - y * y).sqrt()
    return torch.stack((radius * turn.cos(), y, radius * turn.sin()), -1)


def some_rotation(seed: int = 0) -> Tensor:
    """A rotation ``(3, 3)`` that is no symmetry of anything."""
    q, _ = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE))
    return q * torch.linalg.det(q)


def rotation_about(axis: Tensor, angle: float) -> Tensor:
    """Rotation ``(3, 3)`` about an axis by Rodrigues' formula."""
    x, y, z = (axis / axis.norm()).tolist()
    cross = torch.tensor([[0.0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=DOUBLE)
    return torch.eye(3, dtype=DOUBLE) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def cell_width(grid: SphereGrid) -> float:
    """Side of a square as large as the mean cell, in radians."""
    return math.sqrt(grid.solid_angles.sum().item() / math.prod(grid.shape))


# Rotations that map a grid onto itself


def turns_of_columns(grid: SphereGrid) -> list[Tensor]:
    columns = grid.shape[1]
    steps = (rotation_about(UP, k * 2 * math.pi / columns) for k in (1, 5, columns // 2))
    return [rotation_about(AHEAD, math.pi), *steps]


def cube_rotations(grid: SphereGrid) -> list[Tensor]:
    """All twenty-four."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = torch.eye(3, dtype=DOUBLE)[list(order)] * torch.tensor(signs, dtype=DOUBLE)
            if torch.linalg.det(matrix) > 0:
                found.append(matrix)
    assert len(found) == 24
    return found


def quarter_turns(grid: SphereGrid) -> list[Tensor]:
    return [rotation_about(AHEAD, math.pi), *(rotation_about(UP, k * math.pi / 2) for k in (1, 2, 3))]


def fifth_turns(grid: SphereGrid) -> list[Tensor]:
    return [rotation_about(UP, k * 2 * math.pi / 5) for k in range(1, 5)]


def icosahedral_rotations(grid: SphereGrid) -> list[Tensor]:
    """The sixty rotations of the icosahedron: wherever one edge can go, in either direction."""
    corners = Icosphere(0, dtype=DOUBLE).vertices
    edges = [(a, b) for a in corners for b in corners if 0.4 < a @ b < 0.5]
    assert len(edges) == 60

    def frame(a: Tensor, b: Tensor) -> Tensor:
        side = torch.linalg.cross(a, b)
        side = side / side.norm()
        return torch.stack((a, side, torch.linalg.cross(a, side)), -1)

    first = frame(*edges[0])
    return [frame(a, b) @ first.T for a, b in edges]


# Where interpolation could go wrong: which directions (n,) lie within about a cell of there

Places = dict[str, Tensor]


def at_seam(grid: SphereGrid, directions: Tensor) -> Places:
    longitude, _ = longitude_latitude_from_directions(directions)
    return {"seam": longitude.abs() > math.pi - cell_width(grid)}


def at_seam_and_poles(grid: SphereGrid, directions: Tensor) -> Places:
    _, latitude = longitude_latitude_from_directions(directions)
    return {**at_seam(grid, directions), "poles": latitude.abs() > math.pi / 2 - 2 * cell_width(grid)}


def at_cube_edges(grid: SphereGrid, directions: Tensor) -> Places:
    size, tangents = grid.shape[-1], directions.abs() / directions.abs().amax(-1, keepdim=True)
    middle, large, _ = tangents.sort(-1).values.unbind(-1)
    return {"edges": large > 1 - 1 / size, "corners": middle > 1 - 1 / size}


def at_icosahedron_edges(grid: SphereGrid, directions: Tensor) -> Places:
    ico = Icosphere(0, dtype=DOUBLE)
    _, weights = ico.locate(directions)
    near_corner = (directions @ ico.vertices.T).amax(-1) > math.cos(2 * cell_width(grid))
    return {"borders": weights.amin(-1) < cell_width(grid), "vertices": near_corner}


# Which values answer for their own direction, and where interpolation has values on all sides


def every_value(grid: SphereGrid) -> Tensor:
    return torch.ones(grid.shape, dtype=torch.bool)


def outside_margins(grid: TangentImages) -> Tensor:
    """Overlapping patches: those pixels that lie in the patch's own face."""
    patch, _ = grid.face_coordinates(grid.directions)
    _, weights = Icosphere(grid.base_level, dtype=DOUBLE).locate(grid.directions)
    on_a_border = weights.amin(-1) < 1e-9  # where rounding decides
    return (patch == torch.arange(grid.num_patches)[:, None, None]) & ~on_a_border


def everywhere(grid: SphereGrid, directions: Tensor) -> Tensor:
    return torch.ones_like(directions[..., 0], dtype=torch.bool)


def between_centres(grid: Equirectangular, directions: Tensor) -> Tensor:
    u, v = grid.pixels(directions).unbind(-1)
    inside = (v >= 0) & (v <= grid.height - 1)
    return inside if grid.image_edges == "around" else inside & (u >= 0) & (u <= grid.width - 1)


class GridEntry(NamedTuple):
    make: Callable[[int], SphereGrid]
    """The grid at a scale; twice the scale has half the distance between values."""
    symmetries: Callable[[SphereGrid], list[Tensor]]
    """Rotations that map it onto itself."""
    awkward: Callable[[SphereGrid, Tensor], Places]
    """Places where interpolation could be worse than elsewhere."""
    owned: Callable[..., Tensor] = every_value
    """Which values (*shape) answer for their own direction."""
    inside: Callable[..., Tensor] = everywhere
    """Directions with values on all sides."""
    share: float = 1.0
    """Of the sphere that it covers."""
    cells: float = 0.06
    """How far cells of ``nearest`` may differ from the stated solid angles, in mean cells."""


GRIDS: dict[str, GridEntry] = {
    "equirectangular": GridEntry(
        lambda k: Equirectangular(8 * k, 16 * k, dtype=DOUBLE), turns_of_columns, at_seam_and_poles
    ),
    "latitudes": GridEntry(
        lambda k: Equirectangular(6 * k, 16 * k, dtype=DOUBLE, max_latitude=1.0),
        turns_of_columns,
        at_seam,
        inside=between_centres,
        share=math.sin(1.0),
    ),
    "corner": GridEntry(  # its longitudes jump by a turn away from its edges
        lambda k: Equirectangular(
            6 * k, 14 * k, dtype=DOUBLE, latitudes=(-1.3, 0.9), longitudes=(1.2, 2 * math.pi)
        ),
        lambda grid: [],
        at_seam,
        inside=between_centres,
        share=(math.sin(0.9) + math.sin(1.3)) / 2 * (2 * math.pi - 1.2) / (2 * math.pi),
    ),
    "cubemap": GridEntry(lambda k: Cubemap(5 * k, dtype=DOUBLE), cube_rotations, at_cube_edges),
    "healpix": GridEntry(lambda k: Healpix(3 * k, dtype=DOUBLE), quarter_turns, at_seam_and_poles),
    "nested": GridEntry(
        lambda k: Healpix(2 ** (1 + k.bit_length()), nested=True, dtype=DOUBLE),
        quarter_turns,
        at_seam_and_poles,
    ),
    # A vertex's third of each triangle is not quite its Voronoi cell.
    "icosphere": GridEntry(
        lambda k: Icosphere(2 + k.bit_length(), dtype=DOUBLE),
        icosahedral_rotations,
        at_icosahedron_edges,
        cells=0.15,
    ),
    "tangent": GridEntry(
        lambda k: TangentImages(0, 6 * k + 1, dtype=DOUBLE),
        fifth_turns,
        at_icosahedron_edges,
        outside_margins,
    ),
}
