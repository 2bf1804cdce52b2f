# SPDX-License-Identifier: Apache-2.0
"""Point location for many directions: a table of one base face instead of the way down for each of them.

The way down is walked once for the cells of a grid over one face of the icosahedron, which by symmetry serves all
twenty. A direction starts in the triangle of its cell and steps across an edge where that is not its own.
Vectors are columns ``(3, m)`` here, a few thousand at a time, so that every operation runs over contiguous memory
that stays in the cache.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from sphericalvision.icosphere.descent import barycentric_weights, base_corners, base_places, descend
from sphericalvision.icosphere.mesh import icosphere_vertices
from sphericalvision.icosphere.topology import chart_vertex_ids

__all__ = ["locate_many"]

#: Directions at once on the CPU; other devices take all.
CHUNK = 8192
#: Cells along an edge of the base face: four for each triangle, within reason.
CELLS, MOST_CELLS = 4, 256
#: Steps across edges before the way down is taken after all.
STEPS = 3


def locate_many(directions: Tensor, level: int) -> tuple[Tensor, Tensor]:
    """``locate`` for directions ``(M, 3)``, faster when there are more of them than vertices.

    Examples:
        >>> ids, weights = locate_many(torch.tensor([[0.0, -2.0, 0.0]]), level=1)
        >>> ids[0, weights[0].argmax()].item()
        0
    """
    tables = _tables(level, directions.dtype, directions.device)
    ids = torch.empty(directions.shape, dtype=torch.long, device=directions.device)
    weights = torch.empty(directions.shape, dtype=directions.dtype, device=directions.device)
    size = CHUNK if directions.device.type == "cpu" else max(1, len(directions))
    with torch.no_grad():
        astray = []
        for start in range(0, len(directions), size):
            part = slice(start, start + size)
            columns = directions[part].T.contiguous()
            unit = columns / columns.square().sum(0).sqrt_().clamp_(min=1e-12)
            place, sign = _cell_triangles(unit, tables)
            found, shares = _corners(unit, place, sign, 2**level, tables)
            ids[part], weights[part] = found.T, shares.T
            away = _outside(shares, level)
            astray.append((away + start, unit[:, away], place[away], sign[away], shares[:, away]))
        _walk(astray, ids, weights, level, tables)
    if directions.requires_grad and torch.is_grad_enabled():
        a, b, c = tables.vertices.T[ids].unbind(1)
        weights = barycentric_weights(F.normalize(directions, dim=-1), (a, b, c))
    return ids, weights


class _Tables(NamedTuple):
    """What does not depend on the directions.

    A *place* is a position in the charts laid out one after the other: a row further is ``n + 1`` places on.
    """

    centers: Tensor  # (20, 3) of the base faces
    shares: Tensor  # (3, 3, 20): matrices that give a direction's weights in a base face, up to scale
    origin: Tensor  # (20,) place of a base face's corner 0
    sign: Tensor  # (20,) of a base face
    step: Tensor  # (cells²,) places from there to the corner 0 of the cell's triangle, where the sign is 1
    turned: Tensor  # (cells²,) sign of that triangle
    cells: int
    ids: Tensor  # (places,) vertices
    vertices: Tensor  # (3, V)


def _cell_triangles(unit: Tensor, tables: _Tables) -> tuple[Tensor, Tensor]:
    """Place and sign ``(m,)`` of the triangles in the middle of the cells of unit vectors ``(3, m)``."""
    face = _nearly_nearest(tables.centers @ unit.float())
    x, y, z = unit
    shares = tables.shares.index_select(2, face)
    shares = shares[:, 0] * x + shares[:, 1] * y + shares[:, 2] * z
    # A NaN becomes some integer: clamped it is a cell like any other.
    across, down = (shares[1:] * (tables.cells / shares.sum(0))).int().clamp_(0, tables.cells - 1)
    cell = down.mul_(tables.cells).add_(across)
    sign = tables.sign.index_select(0, face)
    place = tables.step.index_select(0, cell).mul_(sign).add_(tables.origin.index_select(0, face))
    return place, sign.mul_(tables.turned.index_select(0, cell))


def _outside(weights: Tensor, level: int) -> Tensor:
    """Numbers of the columns with a weight that is NaN or below zero by more than rounding."""
    inside = weights.amin(0) >= -8 * 2**level * torch.finfo(weights.dtype).eps
    return inside.logical_not_().nonzero()[:, 0]


def _walk(
    astray: Sequence[Sequence[Tensor]], ids: Tensor, weights: Tensor, level: int, tables: _Tables
) -> None:
    """Find the triangles of directions that started outside theirs, and write them to their rows of ids and weights.

    Args:
        astray: by chunk: row, unit vector, place, sign and weights of these directions.
        ids: ``(M, 3)``.
        weights: ``(M, 3)``.
    """
    where, unit, place, sign, shares = (torch.cat(column, -1) for column in zip(*astray, strict=True))
    n = 2**level
    for _ in range(STEPS):
        # The neighbour across the edge opposite to the corner whose weight is least.
        a, b, c = shares
        step = torch.where((a <= b) & (a <= c), n + 2, torch.where(b <= c, n + 1, 1)).int()
        place = (place + step * sign).clamp_(n + 1, len(tables.ids) - n - 2)
        sign = -sign
        found, shares = _corners(unit, place, sign, n, tables)
        ids[where], weights[where] = found.T, shares.T
        # Off the chart are no triangles: who gets there takes the way down.
        column, row = place % (n + 1) + sign, place // (n + 1) % (2 * n + 1) + sign
        shares[0].masked_fill_((column < 0) | (column > n) | (row < 0) | (row > 2 * n), -1)
        away = _outside(shares, level)
        where, unit, place, sign, shares = (
            where[away],
            unit[:, away],
            place[away],
            sign[away],
            shares[:, away],
        )
    triangles = descend(unit.T.contiguous(), level)
    ids[where] = triangles.vertex_ids(level)
    weights[where] = barycentric_weights(unit.T, triangles.corners)


def _nearly_nearest(cosines: Tensor) -> Tensor:
    """Row ``(m,)`` of the largest entry of each column ``(20, m)``, up to rounding to 18 bits.

    The bits of positive floats are in the order of their values: with the row number in the last five, a maximum
    finds it several times faster than ``argmax``.
    """
    rows = torch.arange(len(cosines), dtype=torch.int32, device=cosines.device)
    return cosines.view(torch.int32).bitwise_and_(-32).add_(rows[:, None]).amax(0).bitwise_and_(31)


def _corners(unit: Tensor, place: Tensor, sign: Tensor, n: int, tables: _Tables) -> tuple[Tensor, Tensor]:
    """Ids and weights ``(3, m)`` in the triangles at these places."""
    places = torch.cat((place, place + sign, torch.add(place, sign, alpha=n + 1)))
    ids = tables.ids.index_select(0, places)
    corners = tables.vertices.index_select(1, ids).view(3, 3, -1)
    corners -= unit[:, None]
    x, y, z = unit
    (ax, bx, cx), (ay, by, cy), (az, bz, cz) = (component.unbind(0) for component in corners.unbind(0))
    weights = torch.empty_like(unit)
    weights[0] = x * (by * cz - bz * cy) + y * (bz * cx - bx * cz) + z * (bx * cy - by * cx)
    weights[1] = x * (cy * az - cz * ay) + y * (cz * ax - cx * az) + z * (cx * ay - cy * ax)
    weights[2] = x * (ay * bz - az * by) + y * (az * bx - ax * bz) + z * (ax * by - ay * bx)
    return ids.view(3, -1), weights.div_(weights.sum(0))


@lru_cache(maxsize=4)
def _tables(level: int, dtype: torch.dtype, device: torch.device) -> _Tables:
    n, cells = 2**level, min(CELLS * 2**level, MOST_CELLS)
    bases = base_corners(torch.empty(0, dtype=torch.float64))
    middle = (torch.arange(cells, dtype=torch.float64) + 0.5) / cells
    down, across = torch.meshgrid(middle, middle, indexing="ij")
    scale = (down + across).clamp(min=1)  # cells beyond the face serve what rounding puts there
    down, across = (down / scale).flatten(), (across / scale).flatten()
    weights = torch.stack((1 - down - across, across, down), -1)
    start = descend(F.normalize(weights @ bases[0], dim=-1), level)
    chart, row, column, sign = base_places(torch.arange(20))
    vertices = icosphere_vertices(level, torch.float64)
    return _Tables(
        centers=F.normalize(bases.sum(1), dim=-1).float().to(device),
        shares=torch.linalg.inv(bases.mT).permute(1, 2, 0).to(device, dtype).contiguous(),
        origin=((chart * (2 * n + 1) + row * n) * (n + 1) + column * n).int().to(device),
        sign=sign.int().to(device),
        step=(start.row * (n + 1) + start.column).int().to(device),
        turned=start.sign.int().to(device),
        cells=cells,
        ids=chart_vertex_ids(level, device).flatten(),
        vertices=vertices.T.to(device, dtype).contiguous(),
    )
