# SPDX-License-Identifier: Apache-2.0
"""Several 3D crown convolutions in a row for inference, one rectangle at a time from vertices back to vertices.

No crown of all rectangles is ever in memory, and what lies between two convolutions stays in cache.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sphericalvision.crown.fast.hex_native import convolve_rectangles, hex_convolution_pays, hex_factors
from sphericalvision.crown.fast.rectangles import PlaceSum, Rectangles
from sphericalvision.crown.fast.winograd import (
    convolve_padded,
    repeat_border,
    transformed_kernels,
    winograd_pays,
)
from sphericalvision.crown.fast.workspace import Workspace, workspace
from sphericalvision.crown.taps import COL_TAPS, ROW_TAPS, Taps, neighbor_taps, planar_kernel
from sphericalvision.icosphere import level_from_num_vertices

__all__ = ["convolve_chain"]

Layer = tuple[Tensor, Tensor | None]

SLOW_ALONE = 20480
"""A single volume of no more channels x hypotheses x rows than this torch convolves in a slow way."""


@torch.no_grad()
def convolve_chain(
    values: Float[Tensor, "B C N V"], layers: Sequence[Layer], native: bool = False
) -> Float[Tensor, "B O N V"]:
    """Convolve volumes on an icosphere several times, with a ReLU between two times, and exchange at the end.

    The same numbers as ``crown_conv3d`` and ``crown_relu`` in turn between ``to_crown`` and ``from_crown``, in less
    time and memory. Not differentiable.

    Args:
        values: ``(B, in, N, V)``.
        layers: weight ``(out, in, 21)`` and bias ``(out,)`` or None of each convolution.
        native: whether to use operators in C++ where they can; they are compiled when they are first used on a machine.

    Returns:
        ``(B, out, N, V)``.

    Examples:
        >>> values = torch.ones(1, 4, 16, 42)
        >>> convolve_chain(values, [(torch.ones(8, 4, 21), None), (torch.ones(2, 8, 21), None)]).shape
        torch.Size([1, 2, 16, 42])
    """
    level = level_from_num_vertices(values.shape[-1])
    given = values.movedim(1, -1)
    result = values.new_empty(*given.shape[:3], len(layers[-1][0]))
    chain = _native_chain if native and hex_convolution_pays(given, layers[0][0], stride=1) else _chain
    for sample, result_sample in zip(given, result, strict=True):
        chain(sample, level, layers, workspace(), result_sample)
    return result.movedim(-1, 1)


def _native_chain(
    sample: Tensor, level: int, layers: Sequence[Layer], workspace: Workspace, result: Tensor
) -> None:
    """Values ``(N, V, in)`` to the result ``(N, V, out)`` by operators in C++, which need no borders and rectify."""
    count, _, channels = sample.shape
    made_ready = [
        [(hex_factors(weight, taps), bias) for weight, bias in layers] for taps in (COL_TAPS, ROW_TAPS)
    ]
    crown = Rectangles(sample, level, count)
    places = PlaceSum(result, crown.n)
    flat = sample.reshape(-1, channels)
    given = workspace.take("given", (crown.size, channels), sample)
    for group in crown:
        ids = group.places[:, 1:-1, 1:-1, 1:-1]
        torch.index_select(flat, 0, ids.flatten(), out=given)
        values, taps = given.view(*ids.shape, channels), (COL_TAPS, ROW_TAPS)[group.is_row]
        for k, (factors, bias) in enumerate(made_ready[group.is_row], 1):
            made = workspace.take(f"layer {k}", (*ids.shape, len(layers[k - 1][0])), sample)
            convolve_rectangles(values, factors, bias, made, taps, rectify=k < len(layers))
            values = made
        places.add(values, group)
    places.mean()


def _chain(sample: Tensor, level: int, layers: Sequence[Layer], workspace: Workspace, result: Tensor) -> None:
    """Values ``(N, V, in)`` to the result ``(N, V, out)``."""
    count, _, channels = sample.shape
    convolutions = [
        [_Convolution(weight, bias, taps, sample) for weight, bias in layers] for taps in (COL_TAPS, ROW_TAPS)
    ]
    full = count + (-count % 4 if any(c.winograd for c in convolutions[0]) else 0)
    by_five = any(c.slow_alone((full + 2) * (2**level + 3)) for c in convolutions[0])
    crown = Rectangles(sample, level, full, by_five=by_five)
    # Large new tensors cost fresh pages: what lies between two layers is always in the same place.
    widths = [channels, *(len(weight) for weight, _ in layers)]
    padded_size = crown.group_size * (full + 2) * (2 * crown.n + 3) * (crown.n + 3)
    between = [
        workspace.take(f"between {k}", (padded_size, width), sample) for k, width in enumerate(widths[:-1])
    ]
    last = workspace.take("last", (crown.size, widths[-1]), sample)
    places = PlaceSum(result, crown.n)
    flat = sample.reshape(-1, channels)
    for group in crown:
        number, depth, height, width = group.places.shape
        torch.index_select(flat, 0, group.places.flatten(), out=between[0])
        padded = [buffer.view(number, depth, height, width, -1) for buffer in between]
        *middle, end = convolutions[group.is_row]
        for convolution, given, following in zip(middle, padded[:-1], padded[1:], strict=True):
            inner = following[:, 1:-1, 1:-1, 1:-1]
            convolution(given, inner, workspace, rectify=True)
            repeat_border(following, count)
        answer = last.view(number, depth - 2, height - 2, width - 2, -1)
        end(padded[-1], answer, workspace)
        places.add(answer[:, :count], group)
    places.mean()


class _Convolution:
    """One layer, made ready for rectangles of one direction."""

    def __init__(self, weight: Tensor, bias: Tensor | None, taps: Taps, sample: Tensor) -> None:
        self.kernel, self.bias = planar_kernel(weight.unflatten(-1, (3, 7)), taps), bias
        out_channels, in_channels, _ = weight.shape
        volumes = sample.movedim(-1, 0)[None]
        self.winograd = winograd_pays(volumes, sample.shape[1], in_channels, out_channels)
        self.kernels = transformed_kernels(self.kernel, neighbor_taps(taps)) if self.winograd else []

    def slow_alone(self, places: int) -> bool:
        """Whether torch is slow at a single volume of so many hypotheses x rows."""
        direct = not self.winograd and len(self.kernel) > 1
        return direct and self.kernel.shape[1] * places <= SLOW_ALONE

    def __call__(self, padded: Tensor, result: Tensor, workspace: Workspace, rectify: bool = False) -> None:
        """Convolve ``(g, N + 2, h + 2, w + 2, C)`` into ``(g, N, h, w, O)``."""
        if self.winograd:
            convolve_padded(padded, self.kernels, self.bias, result, workspace, rectify)
            return
        if len(self.kernel) == 1:
            result.copy_(self._single(padded)[..., None])
        else:
            result.copy_(F.conv3d(padded.movedim(-1, 1), self.kernel, self.bias).movedim(1, -1))
        if rectify:
            result.relu_()

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
