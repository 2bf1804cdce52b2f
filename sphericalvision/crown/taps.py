# SPDX-License-Identifier: Apache-2.0
"""Seven hexagonal taps as planar kernels, and the convolution of rectangles by them.

A hexagonal neighbourhood is a 3 x 3 square without two opposite corners. Which corners, and which tap lies where,
depends on the kind of rectangle: the taps are the same directions on the sphere, up to a sixth of a turn.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from sphericalvision.core import ArgumentError, check_counts
from sphericalvision.tables import constant_table

Taps = tuple[tuple[int, ...], ...]

# Taps 0 to 5 go round the centre, tap 6; 7 marks the zeros at the two corners that are no neighbours.
COL_TAPS: Taps = ((7, 5, 4), (0, 6, 3), (1, 2, 7))
ROW_TAPS: Taps = ((7, 0, 5), (1, 6, 4), (2, 3, 7))


def check_stride(stride: int, level: int) -> None:
    """Raise ``ArgumentError`` unless a stride leads from a level to one that there is."""
    if stride not in (1, 2) or (stride == 2 and level == 0):
        raise ArgumentError(f"stride: expected 1, or 2 above level 0, got {stride} at level {level}")


class HexagonWeights(nn.Module):
    """Weight ``(out, in, taps)`` and, if there is one, bias of a hexagonal convolution."""

    taps: int

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        stride: int = 1,
        bias: bool = False,
        *,
        kernel_size: None = None,
    ) -> None:
        super().__init__()
        check_counts(in_channels=in_channels, out_channels=out_channels)
        hint = "a kernel is a vertex and its neighbours, and has no size; further layers look further"
        if kernel_size is not None:
            raise ArgumentError(f"kernel_size: expected none, got {kernel_size!r}; {hint}")
        if stride not in (1, 2):
            raise ArgumentError(f"stride: expected 1 or 2, got {stride!r}; {hint}")
        self.stride = stride
        self.weight = nn.Parameter(torch.empty(out_channels, in_channels, self.taps))
        self.bias = nn.Parameter(torch.empty(out_channels)) if bias else None
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Draw weights as ``torch.nn.Conv2d`` does, for a fan-in of ``in_channels * taps``."""
        nn.init.kaiming_uniform_(self.weight, a=math.sqrt(5))
        if self.bias is not None:
            bound = 1 / math.sqrt(self.weight[0].numel())
            nn.init.uniform_(self.bias, -bound, bound)

    def extra_repr(self) -> str:
        out_channels, in_channels, _ = self.weight.shape
        return f"{in_channels}, {out_channels}, stride={self.stride}, bias={self.bias is not None}"


def planar_kernels(
    weight: Float[Tensor, "C_out C_in 7"] | Float[Tensor, "C_out C_in 21"],
) -> Float[Tensor, "2 C_out C_in *depth 3 3"]:
    """Arrange the weight of a convolution as planar kernels of col and of row rectangles.

    A product with ones and zeros, and so exact; where matrix products may use TF32, as convolutions do by default, it
    rounds as these do.
    """
    depth = () if weight.shape[-1] == 7 else (3,)
    rows = weight.reshape(1, -1, 7).expand(2, -1, -1)
    return rows.bmm(_planar_taps(weight.dtype, weight.device)).view(2, *weight.shape[:2], *depth, 3, 3)


@constant_table
def _planar_taps(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Which tap stands where in the planar kernels of both kinds of rectangles, ``(2, 7, 9)``."""
    taps = torch.tensor((COL_TAPS, ROW_TAPS), device=device).flatten(1)
    return F.one_hot(taps, 8)[..., :7].mT.to(dtype).contiguous()


def convolve(
    images: Float[Tensor, "B C_in *N h w"],
    kernel: Float[Tensor, "C_out C_in *depth 3 3"],
    bias: Float[Tensor, " C_out"] | None = None,
    stride: int = 1,
) -> Float[Tensor, "B C_out *N_out h_out w_out"]:
    """Convolve images ``(B, in, h, w)``, or volumes ``(B, in, N, h, w)``, that have a border; the stride is planar."""
    if images.ndim == 4:
        return F.conv2d(images, kernel, bias, stride)
    return F.conv3d(images, kernel, bias, (1, stride, stride))


def repeat_border(images: Float[Tensor, "B C *N h w"]) -> Float[Tensor, "B C *N_padded h+2 w+2"]:
    """Continue images ``(B, C, h, w)`` or volumes ``(B, C, N, h, w)`` by one more of their border values all around."""
    return F.pad(images, (1, 1) * (images.ndim - 2), mode="replicate")


def convolve_rectangles(
    col: Float[Tensor, "B 5 C_in *N long short"],
    row: Float[Tensor, "B 5 C_in *N short long"],
    weight: Float[Tensor, "C_out C_in taps"],
    bias: Float[Tensor, " C_out"] | None = None,
    stride: int = 1,
    relu: bool = False,
    repeat: Callable[[Tensor], Tensor] = repeat_border,
) -> tuple[Float[Tensor, "B 5 C_out *N h w"], Float[Tensor, "B 5 C_out *N w h"]]:
    """Convolve both kinds of rectangles of a crown, continued by their own border values, and rectify if asked for.

    Args:
        col: ``(B, 5, in, [N,] 2n + 1, n + 1)``.
        row: ``(B, 5, in, [N,] n + 1, 2n + 1)``.
        weight: ``(out, in, 7)``, or ``(out, in, 21)`` of index ``7 * depth + tap``.
        bias: ``(out,)``.
        stride: in the plane; along N it is 1.
        relu: whether results are rectified.
        repeat: continues rectangles at their borders.
    """
    results = []
    for rectangles, kernel in zip((col, row), planar_kernels(weight), strict=True):
        result = convolve(repeat(rectangles.flatten(0, 1)), kernel, bias, stride)
        if relu:  # in place where no derivative needs the result
            result = result.relu() if torch.is_grad_enabled() else result.relu_()
        results.append(result.unflatten(0, (-1, 5)))
    return results[0], results[1]
