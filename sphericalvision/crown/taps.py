# SPDX-License-Identifier: Apache-2.0
"""Seven hexagonal taps as planar kernels, and the convolution of rectangles by them.

A hexagonal neighbourhood is a 3 x 3 square without two opposite corners. Which corners, and which tap lies where,
depends on the kind of rectangle: the taps are the same directions on the sphere, up to a sixth of a turn.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from sphericalvision.core import ArgumentError, check_counts
from sphericalvision.kernels import use_triton
from sphericalvision.tables import constant_table

__all__ = [
    "COL_TAPS",
    "ROW_TAPS",
    "HexagonWeights",
    "Taps",
    "check_hexagon",
    "convolve",
    "neighbor_taps",
    "planar_kernel",
    "planar_kernels",
    "repeat_border",
]

Taps = tuple[tuple[int, ...], ...]

# Taps 0 to 5 go round the centre, tap 6; 7 stands for a zero at the two corners that are no neighbours.
COL_TAPS: Taps = ((7, 5, 4), (0, 6, 3), (1, 2, 7))
ROW_TAPS: Taps = ((7, 0, 5), (1, 6, 4), (2, 3, 7))

LARGE = 1 << 20
"""Values from which memory, and not the launch, is what the continuation of a border takes."""


def check_hexagon(stride: int, kernel_size: object = None) -> None:
    """Raise ``ArgumentError`` for a stride, or a size of a kernel, that hexagonal convolutions do not have.

    Examples:
        >>> check_hexagon(2)
    """
    hint = "a kernel is a vertex and its neighbours, and has no size; further layers look further"
    if kernel_size is not None:
        raise ArgumentError(f"kernel_size: expected none, got {kernel_size!r}; {hint}")
    if stride not in (1, 2):
        raise ArgumentError(f"stride: expected 1 or 2, got {stride!r}; {hint}")


class HexagonWeights(nn.Module):
    """Weight ``(out, in, taps)`` and, if there is one, bias of a hexagonal convolution."""

    taps: int

    def __init__(
        self, in_channels: int, out_channels: int, stride: int, bias: bool, kernel_size: object = None
    ) -> None:
        super().__init__()
        check_counts(in_channels=in_channels, out_channels=out_channels)
        check_hexagon(stride, kernel_size)
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


def planar_kernel(weight: Float[Tensor, "*filters 7"], taps: Taps) -> Float[Tensor, "*filters 3 3"]:
    """Arrange seven taps ``(*, 7)`` as a planar kernel ``(*, 3, 3)``."""
    by_tap = F.pad(weight, (0, 1)).unbind(-1)
    return torch.stack([by_tap[tap] for row in taps for tap in row], -1).unflatten(-1, (3, 3))


def planar_kernels(
    weight: Float[Tensor, "C_out C_in 7"] | Float[Tensor, "C_out C_in 21"],
) -> Float[Tensor, "2 C_out C_in *depth 3 3"]:
    """Arrange the weight of a convolution for col and for row rectangles, by one operator.

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


def neighbor_taps(taps: Taps) -> list[int]:
    """Of the nine places of a planar kernel those that hold a tap."""
    return [place for place, tap in enumerate(sum(taps, ())) if tap < 7]


def convolve(
    images: Float[Tensor, "B C_in *N h w"],
    weight: Float[Tensor, "C_out C_in 7"] | Float[Tensor, "C_out C_in 21"],
    taps: Taps,
    bias: Float[Tensor, " C_out"] | None = None,
    stride: int = 1,
    border: bool = False,
    kernel: Float[Tensor, "C_out C_in *depth 3 3"] | None = None,
) -> Float[Tensor, "B C_out *N h_out w_out"]:
    """Convolve rectangles of one kind, continued by their own border values, in plain torch.

    Args:
        images: ``(B, in, h, w)`` or ``(B, in, N, h, w)``.
        weight: ``(out, in, 7)``, or ``(out, in, 21)`` of index ``7 * depth + tap``.
        taps: ``COL_TAPS`` or ``ROW_TAPS``.
        bias: ``(out,)``.
        stride: in the plane; along N it is 1.
        border: whether the images have a border of one more place all around; hypotheses never have one.
        kernel: the weight as a planar kernel, where that is made already.
    """
    if kernel is None:
        kernel = planar_kernel(weight if images.ndim == 4 else weight.unflatten(-1, (3, 7)), taps)
    if not border:
        images = repeat_border(images)
    elif images.ndim == 5:
        images = torch.cat((images[:, :, :1], images, images[:, :, -1:]), 2)
    if images.ndim == 4:
        return F.conv2d(images, kernel, bias, stride)
    return F.conv3d(images, kernel, bias, (1, stride, stride))


def repeat_border(images: Float[Tensor, "B C *N h w"]) -> Float[Tensor, "B C *N_padded h+2 w+2"]:
    """Continue images ``(B, C, h, w)`` or volumes ``(B, C, N, h, w)`` by one more of their border values all around."""
    if use_triton(images, differentiable=True) and images.numel() >= LARGE:
        from sphericalvision.crown.border_triton import RepeatBorder  # Triton is not everywhere

        return RepeatBorder.apply(images)  # type: ignore[no-any-return]
    if images.ndim == 4 and torch.compiler.is_compiling() and torch.is_grad_enabled():
        # Inductor expects another memory format of the gradient of a padding than it gets.
        tall = torch.cat((images[..., :1, :], images, images[..., -1:, :]), -2)
        return torch.cat((tall[..., :1], tall, tall[..., -1:]), -1)
    return F.pad(images, (1, 1) * (images.ndim - 2), mode="replicate")
