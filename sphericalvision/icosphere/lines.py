# SPDX-License-Identifier: Apache-2.0
"""Straight lines of an icosphere: edge after edge without turning, across the seams between charts.

At a vertex with six neighbours, straight on is the neighbour opposite to the one that the line comes from. Parallel to
the seams of the icosahedron, the bands between two opposite vertices of it hold all of these lines: there are six such
bands, one of which is the equator's, and ``2**level - 1`` lines in each, which close after ``5 * 2**level`` edges. What
is left are the thirty edges of the icosahedron itself; they end at its vertices, where no neighbour is opposite.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Int
from torch import Tensor

from sphericalvision.icosphere.locator import locate
from sphericalvision.icosphere.mesh import icosahedron_rectangles, icosphere_vertices
from sphericalvision.icosphere.topology import chart_vertex_ids, check_level


class IcosphereLines(NamedTuple):
    """Vertex ids along all straight lines of an icosphere; with ``n = 2**level``, every edge is in one of them.

    Attributes:
        loops: ``(6 * (n - 1), 5 * n)`` closed lines; the first vertex follows the last.
        edges: ``(30, n + 1)`` from one vertex of the icosahedron to another.
    """

    loops: Int[Tensor, "loops columns"]
    edges: Int[Tensor, "30 vertices"]


def icosphere_lines(level: int, device: torch.device | str | None = None) -> IcosphereLines:
    """Return the straight lines of an icosphere, along which values can be filtered or summed up.

    Each vertex lies on three lines, and each of the twelve with five neighbours on five edges. Columns 0, n, 2n, 3n
    and 4n of a loop lie on edges of the icosahedron; a rotation of the icosahedron takes these columns to one another.

    Examples:
        >>> lines = icosphere_lines(1)
        >>> lines.loops.shape, lines.edges.shape
        (torch.Size([6, 10]), torch.Size([30, 3]))
        >>> lines.loops[0].tolist()  # once around the equator
        [5, 4, 13, 12, 21, 20, 29, 28, 37, 36]
    """
    n = 2 ** check_level(level)
    charts = chart_vertex_ids(level, device)
    step = torch.arange(n + 1, device=device)
    # The band of the equator: up and to the right through each chart, from its left border to the right one.
    row = torch.arange(1, n, device=device)[:, None] + n
    equator = charts[:, row - step[:-1], step[:-1]].transpose(0, 1).flatten(1)
    loops = torch.cat([turn[equator] for turn in _turns_of_the_pole(level, device)])
    border = charts[:, :, 0]
    edges = torch.stack(
        (
            border[:, : n + 1],
            border[:, n:],
            charts[:, n],
            charts[:, 2 * n],
            charts[:, n - step, step],
            charts[:, 2 * n - step, step],
        )
    )
    return IcosphereLines(loops, edges.view(30, n + 1))


def _turns_of_the_pole(level: int, device: torch.device | str | None) -> list[Tensor]:
    """Return where each vertex goes ``(V,)`` in six rotations that take the north pole to the upper hemisphere."""
    vertices = icosphere_vertices(level, torch.float64, device)
    corners = icosahedron_rectangles(torch.float64, device)
    rotations = [torch.arange(len(vertices), device=device)]
    for pole, corner in zip(corners[:, 0, 0], corners[:, 1, 0], strict=True):
        axis = F.normalize(pole + corner, dim=0)  # half a turn about it swaps the two
        turned = 2 * (vertices @ axis)[:, None] * axis - vertices
        ids, weights = locate(turned, level)
        rotations.append(ids.gather(1, weights.argmax(1, keepdim=True)).squeeze(1))
    return rotations
