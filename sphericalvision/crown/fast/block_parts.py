# SPDX-License-Identifier: Apache-2.0
"""What both passes of a block share: places in memory, its convolutions, and statistics added up group by group."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property
from itertools import product
from typing import TypeVar

import torch
from torch import Tensor

from sphericalvision.crown.fast.hex_native import (
    add_gradient_of_weight,
    convolve_rectangles,
    gradient_of_given,
    hex_factors,
    hex_weight_gradient,
    zero_factor_gradients,
)
from sphericalvision.crown.fast.rectangles import RectangleGroup, Rectangles
from sphericalvision.crown.fast.winograd import (
    adjoint_kernels,
    convolve_padded,
    convolve_padded_backward,
    kernel_gradient,
    repeat_border,
    transformed_kernels,
    unpadded,
)
from sphericalvision.crown.fast.workspace import workspace
from sphericalvision.crown.taps import COL_TAPS, ROW_TAPS, neighbor_taps, planar_kernel
from sphericalvision.icosphere import level_from_num_vertices

__all__ = [
    "BlockPlaces",
    "MomentSums",
    "NativeConvolution",
    "TorchConvolution",
    "norm_factors",
    "stack_samples",
]

TAPS = (COL_TAPS, ROW_TAPS)


class BlockPlaces:
    """Where values of a batch ``(B, N, V, C)`` stand.

    Iterating gives, for every group of rectangles of every sample, its number, its places and the sample ``(N, V, C)``.

    Args:
        volumes: ``(B, N, V, C)``.
        native: whether operators in C++ convolve, which take any number N and no borders.
        backward: whether rectangles are followed by two more rows and columns, so that padded values and gradients that
            are shifted against one another lie on grids of the same size; see ``add_gradient_of_rows``.
    """

    def __init__(self, volumes: Tensor, native: bool, backward: bool = False) -> None:
        self.volumes, self.native, self.slack = volumes, native, backward and not native
        _, self.count, vertices, _ = volumes.shape
        level = level_from_num_vertices(vertices)
        self.n = 2**level
        self.full = self.count if native else self.count + -self.count % 4
        self.crown = Rectangles(volumes[0], level, self.full, self.slack)
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

    @cached_property
    def _inner(self) -> dict[tuple[bool, int], tuple[Tensor, torch.Size]]:
        """Of each group the places without borders, and their shape ``(g, N, h, w)``."""
        end = -3 if self.slack else -1
        inner = {
            (group.is_row, group.first): group.places[:, 1 : self.count + 1, 1:end, 1:end]
            for group in self.groups
        }
        return {key: (ids.flatten(), ids.shape) for key, ids in inner.items()}

    def take_inner(self, sample: Tensor, group: RectangleGroup) -> Tensor:
        """Values of one group without borders, ``(g, N, h, w, C)``."""
        ids, shape = self._inner[group.is_row, group.first]
        return sample.view(-1, sample.shape[-1]).index_select(0, ids).view(*shape, -1)

    def norm_gradient(
        self, mean: Tensor, invert: Tensor, scale: Tensor, grad_scale: Tensor, grad_shift: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Factor of the input, and constant, in the gradient of a normalisation by ``scale * invert``, per channel.

        The gradient of the input x is ``scale * invert`` times that of the output, plus ``factor * x + constant``.
        """
        number = len(self.volumes) * self.count * 10 * (2 * self.n + 1) * (self.n + 1)
        by_input = -scale * invert.square() * grad_scale / number
        return by_input, -scale * invert * grad_shift / number - by_input * mean


class NativeConvolution:
    """A convolution of a block by operators in C++; what it is given are values ``(g, N, h, w, C)``."""

    def __init__(self, weight: Tensor, geometry: BlockPlaces, backward: bool = False) -> None:
        self.weight, self.geometry = weight, geometry
        self.factors = [hex_factors(weight, taps, adjoint=backward) for taps in TAPS]
        self.parts = [zero_factor_gradients(weight, taps) for taps in TAPS] if backward else []

    def take(self, sample: Tensor, group: RectangleGroup) -> Tensor:
        """What it is given of values ``(N, V, C)``."""
        return self.geometry.take_inner(sample, group)

    def rectified(self, outputs: Tensor, group: RectangleGroup, to_norm: tuple[Tensor, Tensor]) -> Tensor:
        """What it is given of outputs of another convolution: these normalised and rectified."""
        factor, offset = to_norm
        return torch.addcmul(offset, self.geometry.view(outputs, group), factor).relu_()

    def inner(self, given: Tensor) -> Tensor:
        """Values ``(g, N, h, w, C)`` of what it is given."""
        return given

    def __call__(self, given: Tensor, group: RectangleGroup, result: Tensor) -> None:
        """Convolve into ``(g, N', h, w, O)``."""
        convolve_rectangles(given, self.factors[group.is_row], None, result, TAPS[group.is_row])

    def upstream(self, group: RectangleGroup) -> Tensor:
        """Where ``gradients`` wants the gradient of results, ``(g, N, h, w, O)``."""
        _, shape = self.geometry._inner[group.is_row, group.first]
        return workspace().take("upstream", (*shape, len(self.weight)), self.weight)

    def gradients(self, given: Tensor, group: RectangleGroup, wanted: bool = True) -> Tensor | None:
        """Count in the weight's gradient and return, if ``wanted``, that of the values given, ``(g, N, h, w, C)``."""
        upstream = self.upstream(group)
        add_gradient_of_weight(given, upstream, self.parts[group.is_row], TAPS[group.is_row])
        if not wanted:
            return None
        grad_given = workspace().take("grad_given", given.shape, given).zero_()
        gradient_of_given(upstream, self.factors[group.is_row], grad_given, TAPS[group.is_row])
        return grad_given

    def weight_gradient(self) -> Tensor:
        """The gradient of the weight, of all groups."""
        col, row = (
            hex_weight_gradient(parts, self.weight, taps)
            for parts, taps in zip(self.parts, TAPS, strict=True)
        )
        return col + row


class TorchConvolution:
    """A convolution of a block in PyTorch; what it is given is padded, ``(g, N' + 2, h + 2, w + 2, C)``."""

    def __init__(self, weight: Tensor, geometry: BlockPlaces, backward: bool = False) -> None:
        self.weight, self.geometry, self.backward = weight, geometry, backward
        self.kernels = _transformed_weight(weight, adjoint_kernels if backward else transformed_kernels)
        self.padded = self._buffer(weight.shape[1], 2 if backward else 0)
        if backward:
            self.grad_padded = self._buffer(weight.shape[1], 0)
            size = self.geometry.crown.group_size * geometry.full * (2 * geometry.n + 5) * (geometry.n + 5)
            self.upstreams = weight.new_zeros(2, size, len(weight))  # zeros around: each kind keeps its own
            self.sums = [weight.new_zeros(6, 4, 3, *weight.shape[:2]) for _ in TAPS]
            self.taps = [neighbor_taps(taps) for taps in TAPS]

    def _buffer(self, channels: int, more: int) -> Tensor:
        """For padded volumes of a group, all zero."""
        crown, full, n = self.geometry.crown, self.geometry.full, self.geometry.n
        size = crown.group_size * (full + 2) * (2 * n + 3 + more) * (n + 3 + more)
        return self.weight.new_zeros(size, channels)

    def take(self, sample: Tensor, group: RectangleGroup) -> Tensor:
        """What it is given of values ``(N, V, C)``."""
        flat = sample.view(-1, sample.shape[-1])
        torch.index_select(flat, 0, group.places.flatten(), out=self.padded)
        return self.padded.view(*group.places.shape, -1)

    def rectified(self, outputs: Tensor, group: RectangleGroup, to_norm: tuple[Tensor, Tensor]) -> Tensor:
        """What it is given of outputs of another convolution: these normalised, rectified and padded."""
        padded, count = self.padded.view(*group.places.shape, -1), self.geometry.count
        with_border = padded[:, :, :-2, :-2] if self.backward else padded
        inner = with_border[:, 1 : count + 1, 1:-1, 1:-1]
        factor, offset = to_norm
        torch.addcmul(offset, self.geometry.view(outputs, group)[:, :count], factor, out=inner).relu_()
        repeat_border(with_border, count)
        return padded

    def inner(self, given: Tensor) -> Tensor:
        """Values ``(g, N, h, w, C)`` of what it is given."""
        end = -3 if self.backward else -1
        return given[:, 1 : self.geometry.count + 1, 1:end, 1:end]

    def __call__(self, given: Tensor, group: RectangleGroup, result: Tensor) -> None:
        """Convolve into ``(g, N', h, w, O)``."""
        convolve_padded(given, self.kernels[group.is_row], None, result, workspace())

    def _zero_bordered(self, group: RectangleGroup) -> Tensor:
        number, depth, height, width = group.places.shape
        return self.upstreams[int(group.is_row)].view(number, depth - 2, height, width, -1)

    def upstream(self, group: RectangleGroup) -> Tensor:
        """Where ``gradients`` wants the gradient of results, ``(g, N, h, w, O)``."""
        return self._zero_bordered(group)[:, : self.geometry.count, 2:-2, 2:-2]

    def gradients(self, given: Tensor, group: RectangleGroup, wanted: bool = True) -> Tensor | None:
        """Count in the weight's gradient and return, if ``wanted``, that of the values given, ``(g, N, h, w, C)``."""
        number, depth, height, width = group.places.shape
        padded = self.grad_padded.view(number, depth, height - 2, width - 2, -1).zero_() if wanted else None
        convolve_padded_backward(
            self._zero_bordered(group),
            given,
            self.kernels[group.is_row],
            padded,
            self.sums[group.is_row],
            workspace(),
            self.taps[group.is_row],
        )
        return None if padded is None else unpadded(padded, self.geometry.count)

    def weight_gradient(self) -> Tensor:
        """The gradient of the weight, of all groups."""
        grad_weight = self.weight.new_zeros(*self.weight.shape[:2], 3, 8)
        for taps, sums in zip(TAPS, self.sums, strict=True):
            grad_weight.index_add_(-1, torch.tensor(sum(taps, ()), device=sums.device), kernel_gradient(sums))
        return grad_weight[..., :7].flatten(-2)


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


Kernel = TypeVar("Kernel")


def _transformed_weight(weight: Tensor, transform: Callable[..., Kernel]) -> list[Kernel]:
    """Kernels of both kinds of rectangles, made ready."""
    planar = [planar_kernel(weight.unflatten(-1, (3, 7)), taps) for taps in TAPS]
    return [transform(kernel, neighbor_taps(taps)) for kernel, taps in zip(planar, TAPS, strict=True)]


def stack_samples(samples: list[Tensor]) -> Tensor:
    """One tensor of all; without a copy if there is only one."""
    return samples[0][None] if len(samples) == 1 else torch.stack(samples)


def norm_factors(mean: Tensor, invert: Tensor, scale: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
    """Factor and offset that normalise."""
    factor = invert * scale
    return factor, shift - mean * factor
