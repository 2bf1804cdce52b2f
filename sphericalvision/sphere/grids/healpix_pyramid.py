# SPDX-License-Identifier: Apache-2.0
"""Values on HEALPix on the next coarser level (four pixels become one) and on the next finer one."""

from __future__ import annotations

import math

import torch
from jaxtyping import Num, Shaped
from torch import Tensor

from sphericalvision.core import ArgumentError, ShapeError, check_choice
from sphericalvision.sphere.grids.healpix_pixels import nested_from_ring, ring_from_nested

POOL_MODES = ("mean", "max")


def healpix_pool(
    values: Num[Tensor, "*batch pixels"], mode: str = "mean", nested: bool = False
) -> Num[Tensor, "*batch coarse"]:
    """Pool values on HEALPix of half the ``nside``: each pixel gathers the four that it contains.

    All pixels have one area, so the mean keeps the integral. Several steps give a pyramid.

    Args:
        values: ``(*, 12 * nside**2)``, nside a power of two, 2 or more.
        mode: ``"mean"``, or ``"max"``.
        nested: whether pixels are numbered nested, before and after, or ring by ring.

    Returns:
        ``(*, 3 * nside**2)``.

    Examples:
        >>> healpix_pool(torch.arange(48.0), nested=True)[:3].tolist()
        [1.5, 5.5, 9.5]
        >>> healpix_pool(torch.ones(2, 768)).shape
        torch.Size([2, 192])
    """
    check_choice("mode", mode, POOL_MODES)
    nside = _nside(values)
    if nside == 1:
        raise ArgumentError("values: expected nside 2 or more to pool, got 1, the twelve base faces")
    if not nested:
        values = values[..., ring_from_nested(torch.arange(12 * nside**2, device=values.device), nside)]
    children = values.unflatten(-1, (-1, 4))
    pooled = children.amax(-1) if mode == "max" else children.mean(-1)
    return pooled if nested else pooled[..., _nested_ids(nside // 2, values)]


def healpix_upsample(
    values: Shaped[Tensor, "*batch pixels"], nested: bool = False
) -> Shaped[Tensor, "*batch fine"]:
    """Values on HEALPix of twice the ``nside``: each of the four pixels within one has its value.

    For values interpolated between pixels take ``resample``.

    Args:
        values: ``(*, 12 * nside**2)`` of any dtype, nside a power of two.
        nested: whether pixels are numbered nested, before and after, or ring by ring.

    Returns:
        ``(*, 48 * nside**2)``.

    Examples:
        >>> healpix_upsample(torch.arange(12), nested=True)[:6].tolist()
        [0, 0, 0, 0, 1, 1]
    """
    nside = _nside(values)
    if nested:
        return values.repeat_interleave(4, -1)
    parents = torch.div(_nested_ids(2 * nside, values), 4, rounding_mode="floor")
    return values[..., ring_from_nested(parents, nside)]


def _nested_ids(nside: int, like: Tensor) -> Tensor:
    """Nested numbers of all pixels, ring by ring."""
    return nested_from_ring(torch.arange(12 * nside**2, device=like.device), nside)


def _nside(values: Tensor) -> int:
    count = values.shape[-1] if values.ndim else 0
    nside = math.isqrt(count // 12)
    if nside < 1 or 12 * nside**2 != count:
        raise ShapeError(f"values: expected shape (*, 12 * nside**2), got {tuple(values.shape)}")
    if nside & (nside - 1):
        raise ArgumentError(f"values: pixels nest for nside 1, 2, 4, 8, ..., got nside {nside}")
    return nside
