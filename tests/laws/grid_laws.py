# SPDX-License-Identifier: Apache-2.0
"""Grids through which every law of the sphere is pushed, and rotations that map them onto themselves."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import torch
from torch import Tensor

from sphericalvision.geometry import longitude_latitude_from_directions
from sphericalvision.sphere import Cubemap, Equirectangular, Healpix, Icosphere, SphereGrid, TangentImages

DOUBLE = torch.float64

# Grids by name and scale: twice the scale has half the distance between values.
MAKERS: dict[str, Callable[[int], SphereGrid]] = {
    "equirectangular": lambda k: Equirectangular(8 * k, 16 * k, dtype=DOUBLE),
    "cubemap": lambda k: Cubemap(5 * k, dtype=DOUBLE),
    "healpix": lambda k: Healpix(3 * k, dtype=DOUBLE),
    "nested": lambda k: Healpix(2 ** (1 + k.bit_length()), nested=True, dtype=DOUBLE),
    "icosphere": lambda k: Icosphere(2 + k.bit_length(), dtype=DOUBLE),
    "tangent": lambda k: TangentImages(0, 6 * k + 1, dtype=DOUBLE),
}


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


def symmetries(name: str, grid: SphereGrid) -> list[Tensor]:
    """Rotations that map the grid onto itself."""
    up, ahead = torch.tensor([0.0, -1, 0], dtype=DOUBLE), torch.tensor([0.0, 0, 1], dtype=DOUBLE)
    over = rotation_about(ahead, math.pi)
    if name == "equirectangular":
        columns = grid.shape[1]
        return [over, *(rotation_about(up, k * 2 * math.pi / columns) for k in (1, 5, columns // 2))]
    if name == "cubemap":
        found = []
        for order in itertools.permutations(range(3)):
            for signs in itertools.product((1.0, -1.0), repeat=3):
                matrix = torch.eye(3, dtype=DOUBLE)[list(order)] * torch.tensor(signs, dtype=DOUBLE)
                if torch.linalg.det(matrix) > 0:
                    found.append(matrix)
        assert len(found) == 24
        return found
    if name in ("healpix", "nested"):
        return [over, *(rotation_about(up, k * math.pi / 2) for k in (1, 2, 3))]
    if name == "icosphere":
        return icosahedral_rotations()
    return [rotation_about(up, k * 2 * math.pi / 5) for k in range(1, 5)]


def icosahedral_rotations() -> list[Tensor]:
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


def in_awkward_places(name: str, grid: SphereGrid, directions: Tensor) -> dict[str, Tensor]:
    """Which directions (n,) lie within about a cell of a seam, a pole, an edge or a chart's border."""
    longitude, latitude = longitude_latitude_from_directions(directions)
    width = math.sqrt(4 * math.pi / math.prod(grid.shape))
    poles = latitude.abs() > math.pi / 2 - 2 * width
    if name in ("equirectangular", "healpix", "nested"):
        return {"seam": longitude.abs() > math.pi - width, "poles": poles}
    if name == "cubemap":
        size, tangents = grid.shape[-1], directions.abs() / directions.abs().amax(-1, keepdim=True)
        middle, large, _ = tangents.sort(-1).values.unbind(-1)
        return {"edges": large > 1 - 1 / size, "corners": middle > 1 - 1 / size}
    _, weights = Icosphere(0, dtype=DOUBLE).locate(directions)
    corners = Icosphere(0, dtype=DOUBLE).vertices
    return {
        "borders": weights.amin(-1) < width,
        "vertices": (directions @ corners.T).amax(-1) > math.cos(2 * width),
    }
