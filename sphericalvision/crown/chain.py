# SPDX-License-Identifier: Apache-2.0
"""Several 3D crown convolutions in a row for inference, one rectangle at a time from vertices back to vertices.

No crown of all rectangles is ever in memory, and what lies between two convolutions stays in cache.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from sphericalvision.crown.conv import COL_TAPS, ROW_TAPS, _check_weight, _planar_kernel, crown_conv3d
from sphericalvision.crown.hexpad import check_values
from sphericalvision.crown.layout import (
    Crown,
    _charts,
    _place_ids,
    crown_relu,
    from_crown,
    places_per_vertex,
    to_crown,
)
from sphericalvision.crown.winograd import convolve_padded, transformed_kernels, winograd_pays

__all__ = ["crown_conv3d_chain"]

CACHE_BYTES = 8 << 20
"""Five rectangles that together take no more than this go through the chain together."""

Layer = tuple[Tensor, Tensor | None]


def crown_conv3d_chain(values: Tensor, layers: Sequence[Layer]) -> Tensor:
    """Convolve volumes on an icosphere several times, with a ReLU between two times, and exchange at the end.

    The same numbers as ``crown_conv3d`` and ``crown_relu`` in turn between ``to_crown`` and ``from_crown``, in less
    time and memory. Not differentiable.

    Args:
        values: ``(B, in, N, V)``.
        layers: weight ``(out, in, 21)`` and bias ``(out,)`` or None of each convolution.

    Returns:
        ``(B, out, N, V)``.

    Raises:
        ShapeError: if the values or a weight do not fit.

    References:
        Komatsu et al. (2020), CrownConv in three dimensions.

    Examples:
        >>> values = torch.ones(1, 4, 16, 42)
        >>> crown_conv3d_chain(values, [(torch.ones(8, 4, 21), None), (torch.ones(2, 8, 21), None)]).shape
        torch.Size([1, 2, 16, 42])
    """
    level, channels = check_values(values, 3), values.shape[1]
    for weight, _ in layers:
        _check_weight(weight, 21, channels)
        channels = len(weight)
    if torch.compiler.is_compiling():
        return _whole(values, layers)
    samples = [_chain(rows, level, layers) for rows in values.movedim(1, -1)]
    return (samples[0][None] if len(samples) == 1 else torch.stack(samples)).movedim(-1, 1)


def _whole(values: Tensor, layers: Sequence[Layer]) -> Tensor:
    """The same on whole crowns, for compilers, which are slow at many slices."""
    crown = crown_conv3d(to_crown(values), *layers[0])
    for layer in layers[1:]:
        crown = crown_conv3d(crown_relu(crown), *layer)
    return from_crown(crown)


def _chain(rows: Tensor, level: int, layers: Sequence[Layer]) -> Tensor:
    """Values ``(N, V, in)`` to values ``(N, V, out)``."""
    n, (count, vertices, channels) = 2**level, rows.shape
    # The rectangles' places, and the borders continued by themselves around them.
    col, row = _place_ids(level, rows.device).split(5)
    wide, across = ([0, *range(m), m - 1] for m in (n + 1, 2 * n + 1))
    col = col.view(5, 2 * n + 1, n + 1)[:, across][:, :, wide]
    row = row.view(5, n + 1, 2 * n + 1)[:, wide][:, :, across]
    down_and_across = [
        [_Convolution(weight, bias, taps, rows) for weight, bias in layers] for taps in (COL_TAPS, ROW_TAPS)
    ]
    full = count + (-count % 4 if any(c.winograd for c in down_and_across[0]) else 0)
    hypotheses = torch.arange(-1, full + 1, device=rows.device).clamp(0, count - 1)
    bytes_of_five = col.numel() * full * channels * rows.element_size()
    together = 5 if rows.device.type != "cpu" or bytes_of_five <= CACHE_BYTES else 1
    # Large new tensors cost fresh pages: what lies between two layers is always in the same place.
    widths = [channels, *(len(weight) for weight, _ in layers)]
    between = [rows.new_empty(together * len(hypotheses) * col[0].numel(), width) for width in widths[:-1]]
    last = rows.new_empty(together * full * (2 * n + 1) * (n + 1), widths[-1])
    sum_of_places = _Sum(rows, n, widths[-1])
    for ids, convolutions in zip((col, row), down_and_across, strict=True):
        places = hypotheses[:, None, None] * vertices + ids[:, None]  # (5, full + 2, h + 2, w + 2)
        for first in range(0, 5, together):
            some = places[first : first + together]
            groups, depth, height, width = some.shape
            torch.index_select(rows.reshape(-1, channels), 0, some.flatten(), out=between[0])
            padded = [buffer.view(groups, depth, height, width, -1) for buffer in between]
            for convolution, given, result in zip(convolutions[:-1], padded[:-1], padded[1:], strict=True):
                convolution(given, result[:, 1:-1, 1:-1, 1:-1])
                _rectify_and_continue(result, count)
            answer = last.view(groups, depth - 2, height - 2, width - 2, -1)
            convolutions[-1](padded[-1], answer)
            sum_of_places.add(answer[:, :count], first, across=ids is row)
    return sum_of_places.mean()


class _Convolution:
    """One layer, made ready for rectangles of one direction."""

    def __init__(
        self, weight: Tensor, bias: Tensor | None, taps: tuple[tuple[int, ...], ...], rows: Tensor
    ) -> None:
        self.kernel, self.bias = _planar_kernel(weight.unflatten(-1, (3, 7)), taps), bias
        volumes = rows.movedim(-1, 0)[None, :, :, None]  # (1, C, N, 1, V)
        self.winograd = winograd_pays(volumes, self.kernel)
        self.kernels = transformed_kernels(self.kernel) if self.winograd else []

    def __call__(self, padded: Tensor, result: Tensor) -> None:
        """Convolve ``(g, N + 2, h + 2, w + 2, C)`` into ``(g, N, h, w, O)``."""
        if self.winograd:
            convolve_padded(padded, self.kernels, self.bias, result)
        elif len(self.kernel) == 1:
            result.copy_(self._single(padded)[..., None])
        else:
            result.copy_(F.conv3d(padded.movedim(-1, 1), self.kernel, self.bias).movedim(1, -1))

    def _single(self, padded: Tensor) -> Tensor:
        """One output channel: a product with all taps at once, and a sum of its rows, shifted."""
        products = self.kernel[0].flatten(1).T @ padded.view(-1, padded.shape[-1]).T
        products = products.view(3, 3, 3, *padded.shape[:-1])
        count, height, width = (size - 2 for size in padded.shape[1:4])
        total = products.new_zeros(()) if self.bias is None else self.bias
        for depth in range(3):
            for down in range(3):
                for right in range(3):
                    shifted = products[depth, down, right][:, depth : depth + count]
                    total = total + shifted[:, :, down : down + height, right : right + width]
        return total


def _rectify_and_continue(padded: Tensor, count: int) -> None:
    """Apply ReLU inside padded volumes ``(g, N + 2, h + 2, w + 2, C)`` and repeat its border values all around."""
    volumes = padded[:, 1 : count + 1]
    volumes[:, :, 1:-1, 1:-1].relu_()
    volumes[:, :, 0], volumes[:, :, -1] = volumes[:, :, 1], volumes[:, :, -2]
    volumes[:, :, :, 0], volumes[:, :, :, -1] = volumes[:, :, :, 1], volumes[:, :, :, -2]
    padded[:, 0] = padded[:, 1]
    padded[:, count + 1 :] = padded[:, count : count + 1]


class _Sum:
    """The sum of every vertex over all its places, rectangle by rectangle: first those down, then those across.

    The first row and the last column of rectangles down belong to the next one; they are kept apart until the end.
    """

    def __init__(self, rows: Tensor, n: int, channels: int) -> None:
        count, vertices, _ = rows.shape
        self.n = n
        self.values = rows.new_empty(count, vertices, channels)
        self.charts = self.values[:, 1:-1].view(count, 5, 2 * n, n, channels)
        self.top = rows.new_empty(count, 5, n + 1, channels)
        self.east = rows.new_empty(count, 5, 2 * n, channels)

    def add(self, rectangles: Tensor, first: int, across: bool) -> None:
        """Add rectangles ``(g, N, h, w, C)``, the first of which is number ``first``."""
        n = self.n
        for k, rectangle in enumerate(rectangles, first):
            if not across:
                self.charts[:, k] = rectangle[:, 1:, :-1]
                self.top[:, k], self.east[:, k] = rectangle[:, 0], rectangle[:, 1:, -1]
                continue
            self.top[:, k] += rectangle[:, 0, : n + 1]
            self.charts[:, k, :n] += rectangle[:, 1:, :n]
            self.east[:, k, :n] += rectangle[:, 1:, n]
            following = (k + 1) % 5
            self.charts[:, following, n - 1 :, 1:] += rectangle[:, :, n + 1 : -1]
            self.east[:, following, n - 1 :] += rectangle[:, :, -1]

    def mean(self) -> Tensor:
        """Values ``(N, V, C)``: the sums by the number of places."""
        n, charts, top, east = self.n, self.charts, self.top, self.east
        self.values[:, 0] = top[:, :, 0].sum(1)
        self.values[:, -1] = east[:, :, -1].sum(1)
        charts[:, :, :n, 0] += top[:, :, 1:].roll(1, 1)
        charts[:, :, n:, 0] += east[:, :, :n].roll(1, 1)
        charts[:, :, -1, 1:] += east[:, :, n:-1].roll(1, 1)
        return self.values.mul_(places_per_vertex(n, self.values)[:, None].reciprocal_())
