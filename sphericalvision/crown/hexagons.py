# SPDX-License-Identifier: Apache-2.0
"""Hexagonal convolutions in plain torch: charts with their true neighbours, then the twelve vertices of valence five.

See ``hexconv`` for taps and orientations.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.crown.charts import fill_charts, hex_pad, ring_values
from sphericalvision.crown.taps import convolve, planar_kernels
from sphericalvision.tables import constant_table

Rings = tuple[tuple[int, ...], ...]
Own = Callable[[Tensor, Tensor, Tensor | None, int], Tensor]

# Taps of the five neighbours as in ``ring_table``, then the tap of the gap: north pole, A and B of charts, south pole.
CHART_RINGS: Rings = ((2, 3, 4, 5, 0, 1), *((1, 2, 3, 4, 5, 0), (3, 4, 5, 0, 1, 2)) * 5, (5, 0, 1, 2, 3, 4))
NORTH_RINGS: Rings = ((2, 3, 4, 0, 1, 5), *((0, 1, 3, 4, 5, 2), (2, 3, 4, 0, 1, 5)) * 5, (4, 0, 1, 2, 3, 5))


def convolve_own(
    values: Float[Tensor, "B C_in *N V"],
    weight: Float[Tensor, "C_out C_in taps"],
    bias: Float[Tensor, " C_out"] | None,
    stride: int,
) -> Float[Tensor, "B 5 C_out *N rows columns"]:
    """Convolve the vertices that charts own with their true neighbours; the first and last hypothesis are repeated."""
    # A coarser chart begins at the second row of the finer one
    charts = hex_pad(values)[..., stride - 1 :, :]
    images = charts.flatten(0, 1)
    if images.ndim == 5:
        images = _repeat_ends(images)
    return convolve(images, planar_kernels(weight)[0], bias, stride).unflatten(0, (-1, 5))


def hexagons(
    values: Float[Tensor, "B C_in *N V"],
    weight: Float[Tensor, "C_out C_in taps"],
    bias: Float[Tensor, " C_out"] | None,
    stride: int,
    north: Float[Tensor, " V"] | None,
    rectify: bool = False,
    residual: Float[Tensor, "B C_out V_out"] | None = None,
    *,
    own: Own = convolve_own,
) -> Float[Tensor, "B C_out *N V_out"]:
    """Convolve values as ``hex_conv2d`` does, or volumes as ``hex_conv3d``; ``own`` computes what charts own."""
    values = values.relu() if rectify else values
    rings, is_volume = ring_values(values), values.ndim == 4
    # Three hypotheses for each, a view; values are volumes of one.
    windows = _repeat_ends(rings).unfold(2, 3, 1) if is_volume else rings[:, :, None, ..., None]
    # What each tap reads of the rings, then one product with all taps.
    special = torch.einsum("binvjd,vjt->bnvidt", windows, _ring_taps(north, values)).flatten(3)
    special = (special @ weight.flatten(1).T).permute(0, 3, 1, 2)
    special = special if bias is None else special + bias[:, None, None]
    special = special if is_volume else special.squeeze(2)
    result = fill_charts(_oriented(values, weight, bias, stride, north, own), special)
    return result if residual is None else residual + result


def _repeat_ends(values: Tensor) -> Tensor:
    """Repeat the first and the last hypothesis of values ``(B, C, N, *)``."""
    return torch.cat((values[:, :, :1], values, values[:, :, -1:]), 2)


def _oriented(
    values: Tensor, weight: Tensor, bias: Tensor | None, stride: int, north: Tensor | None, own: Own
) -> Tensor:
    """Convolve what charts own along the charts, or between the two neighbours on either side of north."""
    if north is None:
        return own(values, weight, bias, stride)
    n = math.isqrt((values.shape[-1] - 2) // 10)
    fraction = north[1:-1].view(5, *(1,) * (values.ndim - 2), 2 * n, n)[..., stride - 1 :: stride, ::stride]
    before, after = own(values, *two_orientations(weight, bias), stride).chunk(2, 2)
    return torch.lerp(before, after, fraction.to(before))


def two_orientations(
    weight: Float[Tensor, "C_out C_in taps"], bias: Float[Tensor, " C_out"] | None
) -> tuple[Float[Tensor, "C_out_twice C_in taps"], Float[Tensor, " C_out_twice"] | None]:
    """Kernels for the two neighbours on either side of north; their results are interpolated.

    The first has tap 5 on the neighbour before north, the second is turned on by one neighbour.
    """
    turned = turned_on(weight.unflatten(-1, (-1, 7))).flatten(2)
    return torch.cat((weight, turned)), None if bias is None else bias.repeat(2)


def turned_on(kernels: Float[Tensor, "*filters 7"]) -> Float[Tensor, "*filters 7"]:
    """Turn kernels ``(*, 7)`` on by one neighbour.

    Examples:
        >>> turned_on(torch.arange(7.0))
        tensor([5., 0., 1., 2., 3., 4., 6.])
    """
    return torch.cat((kernels[..., :6].roll(1, -1), kernels[..., 6:]), -1)


def _ring_taps(north: Tensor | None, values: Tensor) -> Tensor:
    return _taps_of_rings(CHART_RINGS if north is None else NORTH_RINGS, values.dtype, values.device)


@constant_table
def _taps_of_rings(rings: Rings, dtype: torch.dtype, device: torch.device) -> Tensor:
    """What each tap of the twelve special vertices reads of their rings, ``(12, 6, 7)``.

    Values are brought to the taps, not weights to the rings, which are many more.
    """
    taps = torch.tensor(rings, device=device)
    one_hot = torch.eye(7, dtype=dtype, device=device)
    neighbors = one_hot[taps[:, :5]] + one_hot[taps[:, 5:]] / 5  # each is a fifth of the mean in the gap
    return torch.cat((neighbors, one_hot[6].expand(12, 1, 7)), 1)
