# SPDX-License-Identifier: Apache-2.0
"""Convolutions of panoramas by sums of rows, where these are faster than to read tap by tap, and the reading."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.geometry.bilinear import bilinear_sample
from sphericalvision.geometry.image_lookup import taps_across_edges
from sphericalvision.geometry.lookup import weighted_sums
from sphericalvision.kernels import Operator
from sphericalvision.sphere.fast.row_sums import RowSums, adjoint, conv_of_row_sums, row_sums

Pair = tuple[int, int]


def conv_in_rows(
    images: Float[Tensor, "B C_in H W"],
    weight: Float[Tensor, "C_out C_group k_h k_w"],
    bias: Float[Tensor, " C_out"] | None,
    stride: Pair,
    dilation: Pair,
    groups: int,
    taps_of: Callable[..., Tensor],
) -> Float[Tensor, "B C_out H_out W_out"]:
    """Convolve panoramas by sums of rows, with the arguments of ``sphere_conv2d``, and ``sphere_taps`` or one like it;
    ``NotImplemented`` where that does not pay.
    """
    if not _pays(images, weight, stride):
        return NotImplemented
    height, width = images.shape[-2:]
    rows, columns = weight.shape[-2:]
    forward, backward = _sums_of_taps(taps_of, (height, width), (rows, columns), stride, dilation)
    phases = images.unflatten(-1, (-1, stride[1])).transpose(-1, -2).flatten(2, 3)
    result = conv_of_row_sums(phases, weight.flatten(2), forward, backward, groups)
    return result if bias is None else result + bias[:, None, None]


def _pays(images: Tensor, weight: Tensor, stride: Pair) -> bool:
    """On a CPU it is several times faster; not in graphs for other machines."""
    return (
        images.device.type == weight.device.type == "cpu"
        and images.dtype == weight.dtype
        and images.dtype in (torch.float32, torch.float64)
        and min(stride) > 0
        and images.shape[-1] % stride[1] == 0
        and images.numel() > 0
        and not torch.jit.is_tracing()
        and not torch.is_autocast_enabled("cpu")
    )


def _read_by_taps(images: Float[Tensor, "B C H W"], pixels: Float[Tensor, "P 2"]) -> Float[Tensor, "B C P"]:
    """Read panoramas between their pixels: slower, and differentiable any number of times."""
    taps = taps_across_edges(pixels, (images.shape[-2], images.shape[-1]), "sphere")
    return weighted_sums(images.flatten(-2), *taps)


def _read_by_grid(images: Float[Tensor, "B C H W"], pixels: Float[Tensor, "P 2"]) -> Float[Tensor, "B C P"]:
    return bilinear_sample(images, pixels, wrap_longitude=True)


read_pixels = Operator(_read_by_taps, cpu=_read_by_grid, fused=_read_by_grid)


@lru_cache(maxsize=32)
@torch.inference_mode(False)  # the tables outlive the mode they are asked for in
def _sums_of_taps(
    taps_of: Callable[..., Tensor], image_size: Pair, kernel_size: Pair, stride: Pair, dilation: Pair
) -> tuple[RowSums, RowSums]:
    """What taps read between pixels, and the adjoint; columns stand apart by the horizontal stride.

    A row of pixels counts as ``stride`` rows, one for every phase, in which neighbours lie a stride apart.
    """
    (height, width), step = image_size, stride[1]
    taps = taps_of(image_size, kernel_size, stride, dilation, torch.float64, "cpu").flatten(0, 2)
    ids, weight = taps_across_edges(taps, image_size, "sphere")
    tap_ids = torch.arange(len(taps), device="cpu").repeat_interleave(ids.shape[1])
    row, column = ids.flatten() // width, ids.flatten() % width
    row, shift, weight = row * step + column % step, column // step, weight.flatten()
    # The same pixel twice is one entry, and what has no weight is none.
    length = width // step
    keys, index = torch.unique((tap_ids * height * step + row) * length + shift, return_inverse=True)
    weight = weight.new_zeros(len(keys)).index_add_(0, index, weight)
    keys, weight = keys[weight > 0], weight[weight > 0]
    tap_ids, row, shift = keys // length // (height * step), keys // length % (height * step), keys % length
    forward = row_sums(tap_ids, row, shift, weight, len(taps))
    return forward, adjoint(forward, height * step, kernel_size[0] * kernel_size[1], length)
