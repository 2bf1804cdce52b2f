# SPDX-License-Identifier: Apache-2.0
"""Weighted sums of an image's rows, and then of their columns: for samples that lie on a lattice.

Where an image only becomes smaller, the row that a sample reads follows from its row in the target alone, and its
column from its column. Then s x s samples are s rows and s columns, and rows are summed as they lie in memory.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from sphericalvision.geometry.lookup import PlacesInSinglePrecision, weighted_rows
from sphericalvision.kernels import Operator

_EXACT = 1e-8  # pixels: more than rounding in double precision, less than any result shows
_CACHED = 2**18  # summed values that stay in a core's cache until their columns are summed


class Taps(NamedTuple):
    """Which rows, or columns, each row or column of a smaller image is made of."""

    ids: Int[Tensor, "n k"]
    weights: Float[Tensor, "n k"]


class Lattice(NamedTuple):
    """Samples of ``n x m`` cells, by the taps of both axes."""

    rows: Taps
    columns: Taps
    outside: Int[Tensor, " k"]
    """Cells in rows with samples beyond a pole, which are in other columns there: their taps are of no use."""


def _separable_sums(
    images: Float[Tensor, "*batch h w"], rows: Taps, columns: Taps
) -> Float[Tensor, "*batch n m"]:
    """Return weighted sums of rows, and then of columns, of images."""
    height, width = images.shape[-2:]
    lines = images.reshape(-1, width)
    first_lines = torch.arange(0, len(lines), height, device=images.device)
    ids = (first_lines.view(-1, 1, 1) + rows.ids).flatten(0, 1)
    sums = weighted_rows(lines, ids, rows.weights.repeat(len(first_lines), 1))
    column_ids, column_weights = columns.ids.mT.contiguous(), columns.weights.mT.to(lines).contiguous()
    total = sums.index_select(1, column_ids[0]).mul_(column_weights[0])
    for tap in range(1, len(column_ids)):
        total.addcmul_(sums.index_select(1, column_ids[tap]), column_weights[tap])
    return total.view(*images.shape[:-2], len(rows.ids), len(columns.ids))


def _in_chunks(images: Tensor, rows: Taps, columns: Taps) -> Tensor:
    """Sum few rows of the result at once, so that rows stay in the cache until their columns are summed."""
    values = images.shape[-1] * math.prod(images.shape[:-2])
    step = max(1, torch.get_num_threads() * _CACHED // max(1, values))
    chunks = (Taps(*chunk) for chunk in zip(*(table.split(step) for table in rows), strict=True))
    return torch.cat([_separable_sums(images, chunk, columns) for chunk in chunks], -2)


separable_sums = Operator(_separable_sums, cpu=_in_chunks)


def find_lattice(
    u: Float[Tensor, "P m"],
    v: Float[Tensor, "P m"],
    weights: Float[Tensor, "P m"],
    image_size: tuple[int, int],
    edges: str,
) -> Lattice | None:
    """Return the lattice of m samples at (u, v) in each of P cells, row by row of the target; None if on none."""
    width = int(((v - v[0]).abs() < _EXACT).all(-1).sum())
    across = int(((v[0] - v[0, 0]).abs() < _EXACT).sum())
    if width < 2 or len(v) % width or v.shape[1] % across:
        return None
    u, v, weights = (x.view(-1, width, x.shape[1] // across, across) for x in (u, v, weights))
    column, row = u[0, :, 0], v[:, 0, :, 0]
    along = weights.sum((1, 3))
    of_row, of_column = along / width, weights.sum((0, 2)) * width / along.sum()
    product = of_row[:, None, :, None] * of_column[:, None]
    differences = v - row[:, None, :, None], u - column[:, None], weights - product
    if not all(float(difference.abs().max()) <= _EXACT for difference in differences):
        return None
    height, around = image_size[0], edges != "border"
    if around:  # the short way from a cell's first sample
        length = image_size[1]
        column = column[:, :1] + torch.remainder(column - column[:, :1] + length / 2, length) - length / 2
    outside = ((row < -_EXACT) | (row > height - 1 + _EXACT)).any(-1) & (edges == "sphere")
    if bool(outside.all()):
        return None
    rows, columns = _taps(row, of_row, height, False), _taps(column, of_column, image_size[1], around)
    return Lattice(rows, columns, outside.repeat_interleave(width).nonzero()[:, 0])


def _taps(positions: Tensor, weights: Tensor, length: int, around: bool) -> Taps:
    """Linear interpolation at positions ``(n, s)`` of one axis; each pixel is read once."""
    rounded = positions.round()
    positions = torch.where((positions - rounded).abs() < _EXACT, rounded, positions)
    if not around:
        positions = positions.clamp(0, length - 1)
    first = positions.floor()
    fraction = positions - first
    ids = torch.cat((first, first + 1), -1).long()
    weights = torch.cat((weights * (1 - fraction), weights * fraction), -1)
    read = weights > 0
    start = torch.where(read, ids, ids.max()).amin(-1, keepdim=True)
    slots = torch.where(read, ids - start, 0)
    count = int(slots.max()) + 1
    table = weights.new_zeros(len(weights), count).scatter_add_(-1, slots, weights)
    ids = start + torch.arange(count, device=ids.device)
    return Taps(ids.remainder(length) if around else ids.clamp(max=length - 1), table)


class SeparableLookup(PlacesInSinglePrecision):
    """Means over the samples of a lattice, images ``(*b, C, h, w)`` to ``(*b, C, P)``.

    Args:
        lattice: the samples.
        others: lookup of the cells ``outside`` of it, if there are any.
    """

    row_weights: Tensor
    row_ids: Tensor
    column_weights: Tensor
    column_ids: Tensor
    outside: Tensor

    def __init__(self, lattice: Lattice, others: nn.Module | None = None) -> None:
        super().__init__()
        self.others = others
        for axis, taps in (("row", lattice.rows), ("column", lattice.columns)):
            self.register_buffer(f"{axis}_weights", taps.weights, persistent=False)
            self.register_buffer(f"{axis}_ids", taps.ids, persistent=False)
        self.register_buffer("outside", lattice.outside, persistent=False)

    def forward(self, images: Float[Tensor, "*images C h w"]) -> Float[Tensor, "*images C P"]:
        """``images`` (*b, C, height, width) at the targets, (*b, C, P)."""
        rows, columns = Taps(self.row_ids, self.row_weights), Taps(self.column_ids, self.column_weights)
        values = images.to(torch.promote_types(images.dtype, torch.float32))
        result = separable_sums(values, rows, columns).flatten(-2)
        if self.others is not None:
            result.index_copy_(-1, self.outside, self.others(values))
        return result.to(images.dtype)
