# SPDX-License-Identifier: Apache-2.0
"""What both passes of a block share: places in memory, statistics and gradients of weights added up group by group."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product
from typing import TypeVar

import torch
from torch import Tensor

from sphericalvision.crown.fast.rectangles import RectangleGroup, Rectangles
from sphericalvision.crown.fast.winograd import (
    MIN_CHANNELS,
    convolve_padded,
    kernel_gradient,
    repeat_border,
    transformed_kernels,
)
from sphericalvision.crown.fast.winograd_cubes import CubeKernel, convolve_cubes, cube_kernel
from sphericalvision.crown.fast.winograd_rows import PlanarKernel
from sphericalvision.crown.fast.workspace import Workspace
from sphericalvision.crown.taps import COL_TAPS, ROW_TAPS, neighbor_taps, planar_kernel
from sphericalvision.icosphere import level_from_num_vertices

__all__ = [
    "BlockPlaces",
    "MomentSums",
    "WeightGradient",
    "convolve_group",
    "forward_kernels",
    "norm_factors",
    "stack_samples",
    "transformed_weight",
]

TAPS = (COL_TAPS, ROW_TAPS)


class BlockPlaces:
    """Where values of a batch ``(B, N, V, C)`` stand, and buffers of the right sizes.

    Iterating gives, for every group of rectangles of every sample, its number, its places and the sample ``(N, V, C)``.
    With ``slack``, rectangles are followed by two more rows and columns, so that padded values and gradients that are
    shifted against one another lie on grids of the same size; see ``add_gradient_of_rows``.
    """

    def __init__(self, volumes: Tensor, slack: bool = False) -> None:
        self.volumes, self.slack = volumes, slack
        _, self.count, vertices, _ = volumes.shape
        level = level_from_num_vertices(vertices)
        self.n = 2**level
        self.full = self.count + -self.count % 4
        self.crown = Rectangles(volumes[0], level, self.full, slack)
        self.groups = list(self.crown)

    def __iter__(self) -> Iterator[tuple[int, RectangleGroup, Tensor]]:
        return self.over(self.volumes)

    def over(self, values: Tensor) -> Iterator[tuple[int, RectangleGroup, Tensor]]:
        """Iterate with samples of other values ``(B, N, V, *)``."""
        for place, (sample, group) in enumerate(product(values, self.groups)):
            yield place, group, sample

    def outputs(self, channels: int) -> Tensor:
        """What a convolution puts out: ``(groups of all samples, places of a group, channels)``."""
        return self.volumes.new_empty(len(self.volumes) * len(self.crown), self.crown.size, channels)

    def view(self, outputs: Tensor, group: RectangleGroup) -> Tensor:
        """Outputs of one group as ``(g, N', h, w, C)``."""
        number, depth, height, width = group.places.shape
        border = 4 if self.slack else 2
        return outputs.view(number, depth - 2, height - border, width - border, -1)

    def padded(self, channels: int, slack: bool | None = None) -> Tensor:
        """A buffer for padded volumes of a group, all zero."""
        more = 2 if self.slack and slack is not False else 0
        size = self.crown.group_size * (self.full + 2) * (2 * self.n + 3 + more) * (self.n + 3 + more)
        return self.volumes.new_zeros(size, channels)

    def outputs_with_zeros(self, channels: int) -> Tensor:
        """A buffer for outputs of a group with two rows and columns of zeros all around."""
        size = self.crown.group_size * self.full * (2 * self.n + 5) * (self.n + 5)
        return self.volumes.new_zeros(2, size, channels)

    def zero_bordered(self, buffer: Tensor, group: RectangleGroup) -> Tensor:
        """Its part for one group, ``(g, N', h + 4, w + 4, C)``; each kind has its own, so that zeros stay."""
        number, depth, height, width = group.places.shape
        return buffer[int(group.is_row)].view(number, depth - 2, height, width, -1)

    def without_slack(self, buffer: Tensor, group: RectangleGroup) -> Tensor:
        """A buffer as padded volumes ``(g, N' + 2, h + 2, w + 2, C)``."""
        number, depth, height, width = group.places.shape
        return buffer.view(number, depth, height - 2, width - 2, -1)

    def take(self, sample: Tensor, group: RectangleGroup, buffer: Tensor) -> Tensor:
        """Padded volumes of one group."""
        torch.index_select(sample.view(-1, sample.shape[-1]), 0, group.places.flatten(), out=buffer)
        return buffer.view(*group.places.shape, -1)

    def take_inner(self, sample: Tensor, group: RectangleGroup) -> Tensor:
        """Values of one group without borders, ``(g, N, h, w, C)``."""
        end = -3 if self.slack else -1
        places = group.places[:, 1 : self.count + 1, 1:end, 1:end]
        taken = sample.view(-1, sample.shape[-1]).index_select(0, places.flatten())
        return taken.view(*places.shape, -1)

    def rectified(
        self, outputs: Tensor, group: RectangleGroup, to_norm: tuple[Tensor, Tensor], buffer: Tensor
    ) -> Tensor:
        """Outputs of one group normalised, rectified and padded."""
        padded = buffer.view(*group.places.shape, -1)
        with_border = padded[:, :, :-2, :-2] if self.slack else padded
        inner = with_border[:, 1 : self.count + 1, 1:-1, 1:-1]
        factor, offset = to_norm
        torch.addcmul(offset, self.view(outputs, group)[:, : self.count], factor, out=inner).relu_()
        repeat_border(with_border, self.count)
        return padded

    def norm_gradient(
        self, mean: Tensor, invert: Tensor, scale: Tensor, grad_scale: Tensor, grad_shift: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Factor of the input, and constant, in the gradient of a normalisation by ``scale * invert``, per channel.

        The gradient of the input x is ``scale * invert`` times that of the output, plus ``factor * x + constant``.
        """
        number = len(self.volumes) * self.count * 10 * (2 * self.n + 1) * (self.n + 1)
        by_input = -scale * invert.square() * grad_scale / number
        return by_input, -scale * invert * grad_shift / number - by_input * mean


class MomentSums:
    """Mean and biased variance of values ``(*, C)`` that come in groups of equal size."""

    def __init__(self) -> None:
        self.means: list[Tensor] = []
        self.variances: list[Tensor] = []

    def add(self, values: Tensor) -> None:
        """Count a group in."""
        values = values.flatten(0, -2)
        mean = values.mean(0)
        self.means.append(mean)
        self.variances.append((values - mean).square_().mean(0))

    def total(self) -> tuple[Tensor, Tensor]:
        """Those of all groups."""
        means = torch.stack(self.means)
        mean = means.mean(0)
        return mean, torch.stack(self.variances).mean(0) + (means - mean).square_().mean(0)


class WeightGradient:
    """The gradient of a weight ``(out, in, 21)``, gathered from both directions."""

    def __init__(self, weight: Tensor) -> None:
        self.weight = weight
        self.sums = [weight.new_zeros(6, 4, 3, *weight.shape[:2]) for _ in TAPS]
        self.taps = [neighbor_taps(taps) for taps in TAPS]

    def total(self) -> Tensor:
        grad_weight = self.weight.new_zeros(*self.weight.shape[:2], 3, 8)
        for taps, sums in zip(TAPS, self.sums, strict=True):
            grad_weight.index_add_(-1, torch.tensor(sum(taps, ()), device=sums.device), kernel_gradient(sums))
        return grad_weight[..., :7].flatten(-2)


Kernel = TypeVar("Kernel")


def transformed_weight(weight: Tensor, transform: Callable[..., Kernel]) -> list[Kernel]:
    """Kernels of both kinds of rectangles, made ready."""
    planar = [planar_kernel(weight.unflatten(-1, (3, 7)), taps) for taps in TAPS]
    return [transform(kernel, neighbor_taps(taps)) for kernel, taps in zip(planar, TAPS, strict=True)]


def forward_kernels(weight: Tensor, native: bool) -> list[CubeKernel] | list[list[PlanarKernel]]:
    """Kernels of both kinds of rectangles for a forward pass."""
    if native and len(weight) >= MIN_CHANNELS:
        return transformed_weight(weight, cube_kernel)
    return transformed_weight(weight, transformed_kernels)


def convolve_group(
    padded: Tensor, kernel: CubeKernel | list[PlanarKernel], result: Tensor, buffers: Workspace
) -> None:
    if isinstance(kernel, CubeKernel):
        convolve_cubes(padded, kernel, None, result, buffers, native=True)
    else:
        convolve_padded(padded, kernel, None, result, buffers)


def stack_samples(samples: list[Tensor]) -> Tensor:
    """One tensor of all; without a copy if there is only one."""
    return samples[0][None] if len(samples) == 1 else torch.stack(samples)


def norm_factors(mean: Tensor, invert: Tensor, scale: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
    """Factor and offset that normalise."""
    factor = invert * scale
    return factor, shift - mean * factor
