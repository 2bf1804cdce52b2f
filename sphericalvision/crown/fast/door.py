# SPDX-License-Identifier: Apache-2.0
"""The one door to the fast ways: the layers of ``crown`` ask here first and compute plainly where they get None.

Every function gives the numbers of the plain way, or None where it cannot or does not pay: under
``reference_kernels``, for compilers, under the transforms of ``torch.func``, and case by case for other devices,
precisions and sizes. Rectangles come and go as pairs of tensors, col and row.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from sphericalvision.crown.fast.block import NormedLayer, convolve_block
from sphericalvision.crown.fast.chain import convolve_chain
from sphericalvision.crown.fast.hex_native import hex_convolution, hex_convolution_pays
from sphericalvision.crown.fast.layout import Fold, Unfold, places_per_vertex
from sphericalvision.crown.fast.native import native_at_hand, native_operators
from sphericalvision.crown.fast.norms import folded, is_affine, normalize, normalizes, track
from sphericalvision.crown.fast.planar import conv2d_replicate
from sphericalvision.crown.fast.policy import available, wherever_possible
from sphericalvision.crown.fast.winograd import conv3d_winograd, winograd_pays
from sphericalvision.crown.taps import COL_TAPS, ROW_TAPS, convolve, neighbor_taps, planar_kernel

__all__ = [
    "block3d",
    "conv",
    "conv_charts",
    "conv_norm",
    "fold",
    "native_at_hand",
    "native_operators",
    "unfold",
    "wherever_possible",
]

Pair = tuple[Tensor, Tensor]


def unfold(values: Shaped[Tensor, "B C *N V"]) -> Pair | None:
    """Values ``(B, C, [N,] V)`` at all places of the crown."""
    return Unfold.apply(values) if available() else None


def fold(
    col: Float[Tensor, "B 5 C *N h w"], row: Float[Tensor, "B 5 C *N w h"]
) -> Float[Tensor, "B C *N V"] | None:
    """The mean of each vertex over all its places, ``(B, C, [N,] V)``."""
    if not available():
        return None
    return Fold.apply(col, row) * places_per_vertex(col.shape[-1] - 1, col).reciprocal()


def conv(
    col: Float[Tensor, "B 5 C *N h w"],
    row: Float[Tensor, "B 5 C *N w h"],
    weight: Float[Tensor, "O C taps"],
    bias: Float[Tensor, " O"] | None,
    stride: int,
    native: bool = False,
) -> Pair | None:
    """Rectangles ``(B, 5, in, [N,] h, w)`` convolved with a weight ``(out, in, 7)`` or ``(out, in, 21)``."""
    if not available() or stride != 1 or col.device.type != "cpu" or torch.is_autocast_enabled("cpu"):
        return None
    rectangles = zip((col, row), (COL_TAPS, ROW_TAPS), strict=True)
    if native and hex_convolution_pays(col, weight, stride):
        first, second = (
            hex_convolution(images.flatten(0, 1), weight, bias, taps) for images, taps in rectangles
        )
    elif col.ndim == 5:
        # All that the planar way saves is memory for the backward pass.
        if not (torch.is_grad_enabled() and (col.requires_grad or row.requires_grad or weight.requires_grad)):
            return None
        first, second = (
            conv2d_replicate(images.flatten(0, 1), planar_kernel(weight, taps), bias)
            for images, taps in rectangles
        )
    elif winograd_pays(col[0], 10 * (col.shape[-1] - 1) ** 2 + 2, weight.shape[1], len(weight)):
        by_depth = weight.unflatten(-1, (3, 7))
        first, second = (
            conv3d_winograd(volumes.flatten(0, 1), planar_kernel(by_depth, taps), bias, neighbor_taps(taps))
            for volumes, taps in rectangles
        )
    else:
        return None
    return first.unflatten(0, (-1, 5)), second.unflatten(0, (-1, 5))


def conv_charts(
    charts: Float[Tensor, "B 5 C *N h_in w_in"],
    weight: Float[Tensor, "O C taps"],
    bias: Float[Tensor, " O"] | None,
    stride: int,
    native: bool,
) -> Float[Tensor, "B 5 O *N h w"] | None:
    """Charts ``(B, 5, in, [N,] h + 2, w + 2)`` with their border convolved, ``(B, 5, out, [N,] h, w)``."""
    if not (available() and native and hex_convolution_pays(charts, weight, stride)):
        return None
    return hex_convolution(charts.flatten(0, 1), weight, bias, COL_TAPS, border=True).unflatten(0, (-1, 5))


def conv_norm(
    col: Float[Tensor, "B 5 C *N h w"],
    row: Float[Tensor, "B 5 C *N w h"],
    conv_layer: Any,
    norm: Any,
    relu: bool,
) -> Pair | None:
    """A convolution, its normalisation and, if asked for, a ReLU, of the modules ``conv_layer`` and ``norm``."""
    if not available():
        return None
    if is_affine(norm):
        weight, bias = folded(conv_layer.weight, norm)
        pair = conv(col, row, weight, bias, conv_layer.stride, conv_layer.native) or (
            convolve(col, weight, COL_TAPS, bias, conv_layer.stride),
            convolve(row, weight, ROW_TAPS, bias, conv_layer.stride),
        )
        if not relu:
            return pair
        rectify = torch.relu if torch.is_grad_enabled() else torch.relu_
        return rectify(pair[0]), rectify(pair[1])
    if not normalizes(col, norm):
        return None
    weight, bias, stride = conv_layer.weight, conv_layer.bias, conv_layer.stride
    pair = conv(col, row, weight, bias, stride, conv_layer.native) or (
        convolve(col, weight, COL_TAPS, bias, stride),
        convolve(row, weight, ROW_TAPS, bias, stride),
    )
    return normalize(*pair, norm, relu, conv_layer.native)


def block3d(
    volume: Float[Tensor, "B C N V"], first: Any, second: Any, residual: bool
) -> Float[Tensor, "B O N V"] | None:
    """Two layers on the crown of a volume ``(B, C, N, V)``, from vertices to vertices; see ``crown_block3d``.

    ``first`` is a module of a convolution ``conv`` and its normalisation ``norm``, ``second`` another one, or a
    convolution alone.
    """
    if not available():
        return None
    conv_layer, norm = getattr(second, "conv", second), getattr(second, "norm", None)
    native = first.native
    if not torch.is_grad_enabled() and is_affine(first.norm) and (norm is None or is_affine(norm)):
        last = (conv_layer.weight, conv_layer.bias) if norm is None else folded(conv_layer.weight, norm)
        result = convolve_chain(volume, [folded(first.conv.weight, first.norm), last], native)
        return result.add_(volume) if residual else result
    normed = not is_affine(first.norm) and (conv_layer.bias is None if norm is None else not is_affine(norm))
    channels = [layer.weight.shape[:2] for layer in (first.conv, *(() if norm is None else (conv_layer,)))]
    if not normed or not all(
        winograd_pays(volume, volume.shape[-1], fan_in, fan_out, native) for fan_out, fan_in in channels
    ):
        return None
    begin = NormedLayer(first.conv.weight, first.norm.weight, first.norm.bias, first.norm.eps)
    end = (
        NormedLayer(conv_layer.weight)
        if norm is None
        else NormedLayer(conv_layer.weight, norm.weight, norm.bias, norm.eps)
    )
    results = []
    for part in volume.split(1 if first.norm.per_sample else len(volume)):
        result, moments = convolve_block(part, begin, end, native)
        results.append(result)
        for layer_norm, moment in zip((first.norm, norm), moments, strict=False):
            track(layer_norm, moment)
    change = results[0] if len(results) == 1 else torch.cat(results)
    return volume + change if residual else change
