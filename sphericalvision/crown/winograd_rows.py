# SPDX-License-Identifier: Apache-2.0
"""Images convolved 3 x 3 with two thirds of the multiplications or less: Winograd's F(2, 3) along their columns.

Two rows of outputs need four products in place of six, each with a kernel of a single row. The two outer products see
one row of the kernel alone, so that at a hexagon's kernel, whose outer rows have two taps, five ninths are left.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

__all__ = ["ALL_TAPS", "PlanarKernel", "add_gradient_of_rows", "convolve_rows", "of_rows", "planar_kernel"]

ALL_TAPS = tuple(range(9))

# Rows of the transform of three rows of taps; its columns are the rows of the kernel.
_ROWS = ((1.0, 0.0, 0.0), (0.5, 0.5, 0.5), (0.5, -0.5, 0.5), (0.0, 0.0, 1.0))


class PlanarKernel(NamedTuple):
    """A kernel made ready for ``convolve_rows``.

    Attributes:
        whole: ``(O, C, 3, 3)``.
        rows: of the four products, ``(O, C, 1, t)``.
        columns: of each of these, the first and the last of the three columns that it has.
    """

    whole: Tensor
    rows: list[Tensor]
    columns: list[tuple[int, int]]


def planar_kernel(kernel: Tensor, taps: Sequence[int] = ALL_TAPS) -> PlanarKernel:
    """Transform a kernel ``(O, C, 3, 3)``, all of whose taps are zero but those given, of nine."""
    north, center, south = kernel.unbind(2)
    half_sum, half_center = (north + south) / 2, center / 2
    transformed = (north, half_sum + half_center, half_sum - half_center, south)
    columns = _columns(taps)
    rows = [
        row[:, :, None, first : last + 1].contiguous(memory_format=torch.channels_last)
        for row, (first, last) in zip(transformed, columns, strict=True)
    ]
    return PlanarKernel(kernel.contiguous(memory_format=torch.channels_last), rows, columns)


def _columns(taps: Sequence[int]) -> list[tuple[int, int]]:
    """First and last column of each product."""
    of_row = [[tap % 3 for tap in taps if tap // 3 == row] or [1] for row in range(3)]
    of_all = [column for some in of_row for column in some]
    return [(min(some), max(some)) for some in (of_row[0], of_all, of_all, of_row[2])]


def convolve_rows(images: Tensor, kernel: PlanarKernel, bias: Tensor | None = None) -> Tensor:
    """Convolve images ``(B, h + 2, w + 2, C)`` to ``(B, h, w, O)``; contiguous.

    References:
        Winograd (1980), "Arithmetic complexity of computations"; Lavin and Gray (2016), "Fast algorithms for
        convolutional neural networks", for F(2, 3).

    Examples:
        >>> kernel = planar_kernel(torch.ones(1, 2, 3, 3))
        >>> convolve_rows(torch.ones(1, 5, 6, 2), kernel).shape
        torch.Size([1, 3, 4, 1])
    """
    if torch.compiler.is_compiling():  # a compiler takes long for many small products
        return F.conv2d(images.movedim(-1, 1), kernel.whole, bias).movedim(1, -1)
    batch, height, width, _ = images.shape
    result = images.new_empty(batch, height - 2, width - 2, len(kernel.whole))
    even, odd = result[:, ::2], result[:, 1::2]
    biases = (None, bias, None, None)  # the second product is part of every output, times one
    p0, p1, p2, p3 = (
        F.conv2d(tile.movedim(-1, 1), row, b).movedim(1, -1)
        for tile, row, b in zip(_transformed(images, kernel.columns), kernel.rows, biases, strict=True)
    )
    count = odd.shape[1]
    torch.add(p1, p2, out=even).add_(p0)
    torch.sub(p1[:, :count], p2[:, :count], out=odd).sub_(p3)
    return result


def _transformed(images: Tensor, columns: Sequence[tuple[int, int]]) -> Iterator[Tensor]:
    """The four transforms of all tiles of four rows; the last has one row less at an odd number of outputs."""
    width = images.shape[2]
    first0, last0 = columns[0]
    first1, last1 = columns[1]
    first3, last3 = columns[3]
    rows0, rows1, rows2, rows3 = images[:, :-2:2], images[:, 1:-1:2], images[:, 2::2], images[:, 3::2]
    some = slice(first0, width - 2 + last0)
    yield rows0[:, :, some] - rows2[:, :, some]
    some = slice(first1, width - 2 + last1)
    yield rows1[:, :, some] + rows2[:, :, some]
    yield rows2[:, :, some] - rows1[:, :, some]
    some = slice(first3, width - 2 + last3)
    yield rows1[:, : rows3.shape[1], some] - rows3[:, :, some]


def add_gradient_of_rows(of_result: Tensor, images: Tensor, taps: Sequence[int], out: Tensor) -> None:
    """Add to ``out`` the gradient of a kernel's transform: one product a tap of one grid, shifted.

    Args:
        of_result: ``(B, h + 4, w + 4, O)``, the gradient of outputs with two zeros all around.
        images: ``(B, h + 4, w + 4, C)``, images and then two rows and columns that are finite.
        taps: of nine, those wanted.
        out: ``(4, 3, O, C)``; see ``of_rows``.
    """
    even, odd = of_result[:, 2:-2:2], of_result[:, 3:-1:2]
    columns = _columns(taps)
    of_products = even.contiguous(), even + odd, even - odd, -odd
    whole = [(0, 2)] * 4
    for place, tile in enumerate(_transformed(images[:, :-2], whole)):
        rows = tile.flatten(1, 2)
        of_parts = of_products[place][:, : tile.shape[1]].flatten(1, 2)[:, 2:].mT
        number = rows.shape[1] - 2
        first, last = columns[place]
        for tap in range(first, last + 1):
            out[place, tap] += torch.bmm(of_parts, rows[:, tap : tap + number]).sum(0)


def of_rows(of_kernels: Tensor) -> Tensor:
    """Gradients ``(*, 9, O, C)`` of kernels from those of their transforms ``(*, 4, 3, O, C)``."""
    return torch.einsum("mr,...mtoc->...rtoc", of_kernels.new_tensor(_ROWS), of_kernels).flatten(-4, -3)
