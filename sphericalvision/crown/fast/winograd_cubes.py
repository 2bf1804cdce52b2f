# SPDX-License-Identifier: Apache-2.0
"""Volumes convolved 3 x 3 x 3 with an eighth of the multiplications: Winograd's F(4, 3) along all three dimensions.

A cube of 4 x 4 x 4 results takes 6 x 6 x 6 products, less those that are zero because taps of the kernel are: at a
hexagon's kernel 204, in place of 64 x 21. The products are matrix products over channels. The sums around them pass
over much memory in small steps, which takes code of its own (``native``); those in PyTorch are for comparison.

The points of the transforms are 0, +-1 / sqrt(2), +-sqrt(2) and infinity. With the usual +-1 and +-2 in three
dimensions the largest errors would be several times as large.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from sphericalvision.crown.fast.native import native_operators
from sphericalvision.crown.fast.winograd_rows import ALL_TAPS
from sphericalvision.crown.fast.workspace import Workspace

__all__ = [
    "LINE_TAPS",
    "CubeKernel",
    "convolve_cubes",
    "cube_kernel",
    "cubes_pay",
    "results_of_products",
    "tiles_of_volumes",
]

MIN_SIDE = 8
"""Rectangles of shorter sides leave too much of the cubes unused."""

TILE_BYTES = 32 << 20
"""Cubes are taken a few at a time, whose transforms take no more than this."""

_A, _B = math.sqrt(0.5), math.sqrt(2.0)

# Of the transforms of a line of values: of six given ones, of three taps, and of six products to four results.
_GIVEN = (
    (1.0, 0.0, -2.5, 0.0, 1.0, 0.0),
    (0.0, -2 * _A, -2.0, _A, 1.0, 0.0),
    (0.0, 2 * _A, -2.0, -_A, 1.0, 0.0),
    (0.0, -_B / 2, -0.5, _B, 1.0, 0.0),
    (0.0, _B / 2, -0.5, -_B, 1.0, 0.0),
    (0.0, 1.0, 0.0, -2.5, 0.0, 1.0),
)
LINE_TAPS = (
    (1.0, 0.0, 0.0),
    (-2 / 3, -2 / 3 * _A, -1 / 3),
    (-2 / 3, 2 / 3 * _A, -1 / 3),
    (1 / 6, _B / 6, 1 / 3),
    (1 / 6, -_B / 6, 1 / 3),
    (0.0, 0.0, 1.0),
)
_RESULT = (
    (1.0, 1.0, 1.0, 1.0, 1.0, 0.0),
    (0.0, _A, -_A, _B, -_B, 0.0),
    (0.0, 0.5, 0.5, 2.0, 2.0, 0.0),
    (0.0, _A / 2, -_A / 2, 2 * _B, -2 * _B, 1.0),
)


def cubes_pay(volumes: Float[Tensor, " ..."], side: int) -> bool:
    """Whether cubes are faster for rectangles of ``side`` edges times twice as many; they need float32 on a CPU."""
    return side >= MIN_SIDE and volumes.dtype == torch.float32 and volumes.device.type == "cpu"


class CubeKernel(NamedTuple):
    """A kernel made ready for ``convolve_cubes``.

    Attributes:
        factors: ``(6 S, C, O)``, of the places of a cube of products where they are not zero, S in each plane.
        slots: ``(36,)``, which of the S a place in the plane is, or -1.
    """

    factors: Tensor
    slots: Tensor


def cube_kernel(kernel: Float[Tensor, "O C 3 3 3"], taps: Sequence[int] = ALL_TAPS) -> CubeKernel:
    """Transform a kernel ``(O, C, 3, 3, 3)`` on the CPU; of nine taps in the plane all but those given are zero."""
    exact = torch.tensor(LINE_TAPS, dtype=torch.float64)
    transformed = torch.einsum("kd,ri,sj,ocdij->krsco", exact, exact, exact, kernel.double()).to(kernel.dtype)
    is_tap = torch.zeros(9, dtype=torch.float64).index_fill(0, torch.tensor(taps), 1.0).view(3, 3)
    there = (exact.abs() @ is_tap @ exact.abs().T).flatten() > 0
    slots = torch.where(there, there.cumsum(0) - 1, -1)
    return CubeKernel(transformed.flatten(1, 2)[:, there].flatten(0, 1).contiguous(), slots)


def convolve_cubes(
    padded: Float[Tensor, "B N_padded h_padded w_padded C"],
    kernel: CubeKernel,
    bias: Float[Tensor, " O"] | None,
    result: Float[Tensor, "B N h w O"],
    workspace: Workspace,
    rectify: bool = False,
    native: bool = False,
) -> None:
    """Convolve padded volumes ``(B, N + 2, h + 2, w + 2, C)``, N a multiple of four, into ``(B, N, h, w, O)``.

    Args:
        padded: with the values around that the result needs; channels next to each other in memory.
        kernel: ``cube_kernel``.
        bias: ``(O,)``.
        result: overwritten; channels next to each other in memory.
        workspace: of these convolutions.
        rectify: whether a ReLU follows.
        native: whether to take the operators in C++, for float32 on the CPU.

    References:
        Winograd (1980), "Arithmetic complexity of computations"; Lavin and Gray (2016), "Fast algorithms for
        convolutional neural networks", for F(4, 3); Barabasz et al. (2020), "Error analysis and improving the
        accuracy of Winograd convolution for deep neural networks", for the choice of points.
    """
    factors, slots = kernel
    number, channels, out_channels = factors.shape
    batch, count, height, width, _ = result.shape
    places = batch * -(-height // 4) * -(-width // 4)  # of a slab of cubes
    at_most = max(1, TILE_BYTES // (number * places * channels * factors.element_size()))
    slabs = count // 4
    together = -(-slabs // -(-slabs // at_most))  # as even as can be
    for first in range(0, count, 4 * together):
        last = min(first + 4 * together, count)
        size = (last - first) // 4 * places
        tiles = workspace.take("tiles", (number, size, channels), padded)
        products = workspace.take("products", (number, size, out_channels), padded)
        given, slab = padded[:, first : last + 2], result[:, first:last]
        if native:
            native_operators().winograd_tiles(given, slots, tiles)
            torch.bmm(tiles, factors, out=products)
            native_operators().winograd_results(products, slots, bias, rectify, slab)
        else:
            tiles_of_volumes(given, slots, tiles)
            torch.bmm(tiles, factors, out=products)
            results_of_products(products, slots, bias, rectify, slab)


def tiles_of_volumes(
    padded: Float[Tensor, "B N_padded h_padded w_padded C"],
    slots: Int[Tensor, " ..."],
    tiles: Float[Tensor, "planes cubes C"],
) -> None:
    """Transform cubes of ``(B, 4 T + 2, h + 2, w + 2, C)`` into ``(6 S, B * T * R * Q, C)``: ``winograd_tiles``.

    Where h and w are no multiples of four the last values are repeated.
    """
    below, right = (-(size - 2) % 4 for size in padded.shape[2:4])
    filled = F.pad(padded, (0, 0, 0, right, 0, below), mode="replicate")
    cubes = filled.unfold(1, 6, 4).unfold(2, 6, 4).unfold(3, 6, 4)  # (B, T, R, Q, C, 6, 6, 6)
    given = padded.new_tensor(_GIVEN)
    transformed = torch.einsum("btrqcxyz,kx,iy,jz->kijbtrqc", cubes, given, given, given)
    tiles.copy_(transformed.flatten(1, 2)[:, slots >= 0].view(tiles.shape))


def results_of_products(
    products: Float[Tensor, "planes cubes O"],
    slots: Int[Tensor, " ..."],
    bias: Float[Tensor, " O"] | None,
    rectify: bool,
    result: Float[Tensor, "B N h w O"],
) -> None:
    """Transform products ``(6 S, B * T * R * Q, O)`` into ``(B, 4 T, h, w, O)``: ``winograd_results``."""
    batch, count, height, width, channels = result.shape
    all_places = products.new_zeros(6, 36, *products.shape[1:])
    all_places[:, slots >= 0] = products.unflatten(0, (6, -1))
    grid = (batch, count // 4, -(-height // 4), -(-width // 4))
    cubes = all_places.view(6, 6, 6, *grid, channels)
    to_result = products.new_tensor(_RESULT)
    values = torch.einsum("kijbtrqo,xk,yi,zj->btxryqzo", cubes, to_result, to_result, to_result)
    values = values.flatten(1, 2).flatten(2, 3).flatten(3, 4)[:, :, :height, :width]
    if bias is not None:
        values = values + bias
    result.copy_(values.relu() if rectify else values)
