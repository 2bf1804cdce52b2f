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
from jaxtyping import Float
from torch import Tensor

from sphericalvision.crown.fast.workspace import Workspace

__all__ = [
    "ALL_TAPS",
    "PlanarKernel",
    "add_gradient_of_rows",
    "convolve_rows",
    "planar_kernel",
    "row_kernel_gradient",
]

ALL_TAPS = tuple(range(9))

MIN_PLACES = 4000
"""Images of fewer places altogether are convolved with the whole kernel: small products are slow."""

PARTS = 8
"""A sum over places is made in at most so many parts, which a CPU is faster with."""

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


def planar_kernel(kernel: Float[Tensor, "O C 3 3"], taps: Sequence[int] = ALL_TAPS) -> PlanarKernel:
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


def convolve_rows(
    images: Float[Tensor, "B h_padded w_padded C"],
    kernel: PlanarKernel,
    bias: Float[Tensor, " O"] | None,
    out: Float[Tensor, "B h w O"],
    workspace: Workspace,
) -> None:
    """Convolve images ``(B, h + 2, w + 2, C)`` into ``(B, h, w, O)``; both of any strides.

    References:
        Winograd (1980), "Arithmetic complexity of computations"; Lavin and Gray (2016), "Fast algorithms for
        convolutional neural networks", for F(2, 3).
    """
    few = images.shape[:3].numel() < MIN_PLACES or images.shape[1] < 4
    if few or torch.compiler.is_compiling():  # compilers take long for many small products
        out.copy_(F.conv2d(images.movedim(-1, 1), kernel.whole, bias).movedim(1, -1))
        return
    even, odd = out[:, ::2], out[:, 1::2]
    biases = (None, bias, None, None)  # the second product is part of every output, times one
    p0, p1, p2, p3 = (
        F.conv2d(tile.movedim(-1, 1), row, b).movedim(1, -1)
        for tile, row, b in zip(
            _transformed(images, kernel.columns, workspace), kernel.rows, biases, strict=True
        )
    )
    count = odd.shape[1]
    torch.add(p1, p2, out=even).add_(p0)
    torch.sub(p1[:, :count], p2[:, :count], out=odd).sub_(p3)


def _transformed(
    images: Tensor, columns: Sequence[tuple[int, int]], workspace: Workspace
) -> Iterator[Tensor]:
    """The four transforms of all tiles of four rows; the last has one row less at an odd number of outputs."""
    rows = images[:, :-2:2], images[:, 1:-1:2], images[:, 2::2], images[:, 3::2]
    count, width = rows[3].shape[1], images.shape[2] - 2
    for place, (one, other, sign) in enumerate(((0, 2, -1), (1, 2, 1), (2, 1, -1), (1, 3, -1))):
        first, last = columns[place]
        some = slice(None, count if place == 3 else None), slice(first, width + last)
        minuend, subtrahend = (rows[k][:, *some] for k in (one, other))
        shape = minuend.shape
        tile = workspace.take(f"rows {place}", shape, images)
        yield torch.add(minuend, subtrahend, alpha=sign, out=tile)


def add_gradient_of_rows(
    grad_result: Float[Tensor, "B h w O"],
    images: Float[Tensor, "B h_padded w_padded C"],
    taps: Sequence[int],
    out: Float[Tensor, "4 3 O C"],
    workspace: Workspace,
) -> None:
    """Add to ``out`` the gradient of a kernel's transform: one product a tap of one grid, shifted.

    Args:
        grad_result: ``(B, h + 4, w + 4, O)``, the gradient of outputs with two zeros all around.
        images: ``(B, h + 4, w + 4, C)``, images and then two rows and columns that are finite.
        taps: of nine, those wanted.
        out: ``(4, 3, O, C)``; see ``row_kernel_gradient``.
    """
    even, odd = grad_result[:, 2:-2:2], grad_result[:, 3:-1:2]
    columns = _columns(taps)
    # Images follow one another without a gap: what a tap takes from the next one meets a zero.
    parts = max(number for number in range(1, PARTS + 1) if len(images) % number == 0)
    for place, tile in enumerate(_transformed(images[:, :-2], [(0, 2)] * 4, workspace)):
        if place == 3:
            if not tile.numel():  # of a single row
                break
            grad_tile = odd[:, : tile.shape[1]].neg()
        else:
            grad_tile = even.contiguous() if place == 0 else even.add(odd, alpha=3 - 2 * place)
        rows = tile.view(parts, -1, tile.shape[-1])
        grad_rows = grad_tile.view(parts, -1, grad_tile.shape[-1])[:, 2:].mT
        number = rows.shape[1] - 2
        first, last = columns[place]
        for tap in range(first, last + 1):
            out[place, tap] += torch.bmm(grad_rows, rows[:, tap : tap + number]).sum(0)


def row_kernel_gradient(grad_kernels: Float[Tensor, "*batch 4 3 O C"]) -> Float[Tensor, "*batch 9 O C"]:
    """Gradients ``(*, 9, O, C)`` of kernels from those of their transforms ``(*, 4, 3, O, C)``."""
    return torch.einsum("mr,...mtoc->...rtoc", grad_kernels.new_tensor(_ROWS), grad_kernels).flatten(-4, -3)
