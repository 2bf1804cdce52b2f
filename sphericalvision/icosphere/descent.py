# SPDX-License-Identifier: Apache-2.0
"""The way down from a face of the icosahedron to the triangle of a finer icosphere, and weights inside it."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from sphericalvision.icosphere.mesh import icosphere_vertices
from sphericalvision.icosphere.topology import icosphere_faces, vertex_at
from sphericalvision.kernels import full_precision


class Triangles(NamedTuple):
    """Triangles of an icosphere, each by its corner 0 and a sign: corners 1 and 2 are ``sign`` columns, rows away.

    Attributes:
        chart: ``(M,)``, 0 to 4.
        row: ``(M,)`` of corner 0.
        column: ``(M,)`` of corner 0.
        sign: ``(M,)``, 1 or -1.
        corners: positions of the three corners, each ``(M, 3)``.
    """

    chart: Tensor
    row: Tensor
    column: Tensor
    sign: Tensor
    corners: tuple[Tensor, Tensor, Tensor]

    def vertex_ids(self, level: int) -> Int[Tensor, "M 3"]:
        """Ids ``(M, 3)`` of the corners on the icosphere of this level."""
        chart, row, column, sign, _ = self
        rows = torch.stack((row, row, row + sign), -1)
        columns = torch.stack((column, column + sign, column), -1)
        return vertex_at(chart[:, None], rows, columns, level)

    def numbers(self, level: int) -> Int[Tensor, " M"]:
        """Numbers ``(M,)`` of the triangles in ``icosphere_faces`` of this level."""
        n, half = 2**level, (1 - self.sign) // 2
        return 2 * ((self.chart * (2 * n) + self.row - half) * n + self.column - half) + half


def barycentric_weights(
    unit: Float[Tensor, "M 3"],
    corners: tuple[Float[Tensor, "M 3"], Float[Tensor, "M 3"], Float[Tensor, "M 3"]],
) -> Float[Tensor, "M 3"]:
    """Return ``(M, 3)`` weights from determinants of small differences, which are accurate in float32."""
    a, b, c = (corner - unit for corner in corners)
    volumes = torch.stack((triple(unit, b, c), triple(unit, c, a), triple(unit, a, b)), -1)
    return convex(volumes, -1)


def convex(weights: Float[Tensor, " ..."], dim: int) -> Float[Tensor, " ..."]:
    """Weights of three corners ``(*)`` from their weights along ``dim``: none is negative, and they add up to one.

    On an edge rounding gives a corner a little less than nothing. Left so, values above zero could be interpolated to
    one below it.

    Examples:
        >>> convex(torch.tensor([3.0, 1.0, -1e-6]), 0)
        tensor([0.7500, 0.2500, 0.0000])
    """
    weights = weights.clamp(min=0)
    return weights / weights.sum(dim, keepdim=True)


def triple(a: Float[Tensor, "M 3"], b: Float[Tensor, "M 3"], c: Float[Tensor, "M 3"]) -> Float[Tensor, " M"]:
    """Return the determinant of the rows a, b, c, each ``(M, 3)``."""
    return (a * torch.linalg.cross(b, c)).sum(-1)


@full_precision
def descend(unit: Float[Tensor, "M 3"], level: int) -> Triangles:
    """Return the triangles that contain unit vectors ``(M, 3)``; corners are recomputed on the way, in their dtype."""
    vertices = icosphere_vertices(0, torch.float64, unit.device).to(unit.dtype)
    bases = vertices[icosphere_faces(0, unit.device)]
    # The faces of a regular icosahedron are the Voronoi cells of their centres.
    face = (unit @ F.normalize(bases.sum(1), dim=-1).T).argmax(-1)
    # Two cells a chart, two halves a cell: corner 0 is in the north-west, or in the south-east looking back.
    chart, column = face // 4, face % 2
    row, sign = (face // 2) % 2 + column, 1 - 2 * column
    a, b, c = bases[face].unbind(1)
    for _ in range(level):
        ab, bc, ca = (F.normalize(p + q, dim=-1) for p, q in ((a, b), (b, c), (c, a)))
        to_ab, to_bc, to_ca = ab - unit, bc - unit, ca - unit
        at_a = triple(unit, to_ab, to_ca) > 0
        at_b = (triple(unit, to_bc, to_ab) > 0) & ~at_a  # exclusive despite rounding
        at_c = (triple(unit, to_ca, to_bc) > 0) & ~(at_a | at_b)
        inner = ~(at_a | at_b | at_c)
        row = 2 * row + sign * (at_c | inner)
        column = 2 * column + sign * (at_b | inner)
        sign = torch.where(inner, -sign, sign)
        at_a, at_b, at_c = at_a[:, None], at_b[:, None], at_c[:, None]
        a, b, c = (
            torch.where(at_a, a, torch.where(at_b, ab, torch.where(at_c, ca, bc))),
            torch.where(at_a, ab, torch.where(at_b, b, torch.where(at_c, bc, ca))),
            torch.where(at_a, ca, torch.where(at_b, bc, torch.where(at_c, c, ab))),
        )
    return Triangles(chart, row, column, sign, (a, b, c))
