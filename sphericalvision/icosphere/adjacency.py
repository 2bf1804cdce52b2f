# SPDX-License-Identifier: Apache-2.0
"""Adjacency on an icosphere: neighbours, edges, and the faces across edges.

What is around a vertex follows from the *half-edges*: half-edge ``3 * face + corner`` runs from that corner of the face
to the next one, counter-clockwise seen from outside.
"""

from __future__ import annotations

import torch
from jaxtyping import Int
from torch import Tensor

from sphericalvision.icosphere.topology import chart_vertex_ids, check_level, icosphere_faces
from sphericalvision.tables import constant_table, copied


def icosphere_edges(level: int, device: torch.device | str | None = None) -> Int[Tensor, "E 2"]:
    """Return the edges as pairs of vertices, ``(30 * 4**level, 2)``, each edge once.

    Vertex v, unless it is a pole, owns the edges ``3 * (v - 1) + k`` to its neighbours north (k = 0), north-east (1)
    and east (2) in its chart.

    Examples:
        >>> icosphere_edges(0)[:3].tolist()
        [[1, 0], [1, 3], [1, 4]]
    """
    ids = chart_vertex_ids(level, device)
    start = ids[:, 1:, :-1]
    ends = torch.stack((ids[:, :-1, :-1], ids[:, :-1, 1:], ids[:, 1:, 1:]), -1)
    return torch.stack((start[..., None].expand_as(ends), ends), -1).reshape(-1, 2)


@copied
@constant_table
def icosphere_neighbors(level: int, device: torch.device | str | None = None) -> Int[Tensor, "V 6"]:
    """Return the neighbours of every vertex, counter-clockwise seen from outside, ``(V, 6)``.

    The twelve vertices of the icosahedron have five neighbours; their last entry is -1.

    Examples:
        >>> icosphere_neighbors(0)[0]  # the north pole
        tensor([ 1,  9,  7,  5,  3, -1])
    """
    faces = icosphere_faces(level, device)
    around = _half_edges_around(faces)
    ends = faces.roll(-1, 1).flatten()
    return torch.where(around < 0, -1, ends[around])


def icosphere_face_neighbors(level: int, device: torch.device | str | None = None) -> Int[Tensor, "F 3"]:
    """Return the faces across the edges 01, 12 and 20 of every face, ``(F, 3)``.

    Examples:
        >>> icosphere_face_neighbors(0)[0].tolist()  # of the face of the vertices 0, 3, 1
        [4, 1, 16]
    """
    n = 2 ** check_level(level)
    own = torch.arange(20 * n * n, device=device).view(5, 2 * n, n, 2)
    first, second = own.unbind(-1)
    east, west = own.roll(-1, 0), own.roll(1, 0)  # the next chart and the one before
    across = own.new_empty(5, 2 * n, n, 2, 3)
    # Edge 12 is the anti-diagonal of a cell, which its two faces share.
    across[..., 0, 1], across[..., 1, 1] = second, first
    to_north, to_west = across[..., 0, 0], across[..., 0, 2]
    to_south, to_east = across[..., 1, 0], across[..., 1, 2]
    to_west[:, :, 1:], to_east[:, :, :-1] = second[:, :, :-1], first[:, :, 1:]
    to_north[:, 1:], to_south[:, :-1] = second[:, :-1], first[:, 1:]
    # As in ``vertex_at``: the north edge is the upper left edge of the next chart; the east edge is its lower left
    # edge, then its last row.
    to_north[:, 0], to_west[:, :n, 0] = east[:, :n, 0, 0], west[:, 0, :, 0]
    to_east[:, :n, -1], to_west[:, n:, 0] = east[:, n:, 0, 0], west[:, :n, -1, 1]
    to_east[:, n:, -1], to_south[:, -1] = east[:, -1, :, 1], west[:, n:, -1, 1]
    return across.view(-1, 3)


def _half_edges_around(faces: Tensor) -> Tensor:
    """Return the half-edges that leave each vertex, counter-clockwise, ``(V, 6)`` with -1 last."""
    count = len(faces) // 2 + 2  # of vertices, by Euler's formula
    # Half-edge (v, a) of the triangle (v, a, b) is followed by (v, b), which belongs to the next triangle around v.
    center = faces.flatten()
    leaving, arriving = faces.roll(-1, 1).flatten(), faces.roll(-2, 1).flatten()
    key, order = torch.sort(center * count + leaving)
    following = torch.searchsorted(key, center[order] * count + arriving[order])
    edge = torch.searchsorted(key, torch.arange(count, device=faces.device) * count)
    around = []
    for _ in range(6):
        around.append(order[edge])
        edge = following[edge]
    half_edges = torch.stack(around, -1)
    closes_early = half_edges[:, 5] == half_edges[:, 0]
    half_edges[closes_early, 5] = -1
    return half_edges
