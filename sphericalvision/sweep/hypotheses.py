# SPDX-License-Identifier: Apache-2.0
"""Hypotheses: depths spaced evenly in inverse depth, from infinity to the smallest depth, and their indices.

Convention:
    Index ``i`` is 0-based: 0 is infinity, ``N - 1`` is the smallest depth. ``1 / depth = i / ((N - 1) *
    min_depth) + eps`` with the float32 machine epsilon, so that the depth of index 0 is a large number
    (8388608 m) and not infinity. Indices below 0, as rounding makes them, are taken for 0.
    Worked number: 17 hypotheses from 0.5 m put index 8 at 1 m.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Num
from torch import Tensor

from sphericalvision.core import ArgumentError, check_type, short_repr
from sphericalvision.geometry.directions import in_single_precision
from sphericalvision.shapes import check_shapes

_MAX_INDEX = 1e30  # its depth is still above zero in float32
MAX_HYPOTHESES = 4096
"""Twenty times the number of any published network."""
MIN_DEPTHS = 1e-5, 1e5
"""Least and greatest, in metres: far above rounding, and far below the depth of index 0."""
INVERSE_DEPTH_OFFSET = torch.finfo(torch.float32).eps  # 1/m, added to all hypotheses


def check_hypotheses(num_hypotheses: int, min_depth: float) -> None:
    """Raise ``ArgumentError`` unless there are two or more hypotheses and a positive smallest depth."""
    if isinstance(num_hypotheses, bool) or not isinstance(num_hypotheses, int) or num_hypotheses < 2:
        raise ArgumentError(
            f"num_hypotheses: expected an integer of 2 or more, got {short_repr(num_hypotheses)}"
        )
    if num_hypotheses > MAX_HYPOTHESES:
        raise ArgumentError(
            f"num_hypotheses: expected {MAX_HYPOTHESES} at most, got {num_hypotheses}; take fewer"
        )
    check_type("min_depth", min_depth, (int, float), "metres to the nearest hypothesis")
    least, most = MIN_DEPTHS
    if not least <= min_depth <= most:
        raise ArgumentError(
            f"min_depth: expected a positive number of metres, {least:g} to {most:g}, got {min_depth!r}"
        )


def inverse_depth_hypotheses(
    num_hypotheses: int,
    min_depth: float,
    dtype: torch.dtype | None = None,
    device: torch.device | str | None = None,
) -> Float[Tensor, " N"]:
    """Return the inverse depths of the hypotheses in 1/m, ascending, ``(N,)``.

    Raises:
        ArgumentError: if there are fewer than two hypotheses or the smallest depth (in metres) is not
            positive.

    References:
        Won, Ryu and Lim (2019), "SweepNet: wide-baseline omnidirectional depth estimation", section III.

    Examples:
        >>> inverse_depth_hypotheses(3, min_depth=0.5)
        tensor([1.1921e-07, 1.0000e+00, 2.0000e+00])
    """
    check_hypotheses(num_hypotheses, min_depth)
    spaced = torch.linspace(0, 1 / min_depth, num_hypotheses, dtype=torch.float64, device=device)
    return (spaced + INVERSE_DEPTH_OFFSET).to(dtype or torch.get_default_dtype())


@check_shapes
def inverse_depth_from_index(
    index: Num[Tensor, "*batch"], num_hypotheses: int, min_depth: float
) -> Float[Tensor, "*batch"]:
    """Return the inverse depth in 1/m, positive and finite, of (fractional) hypothesis indices ``(*)``.

    Computed in float32 at least, and returned so: half precision has no number for the farthest depth. A NaN stays one.

    Examples:
        >>> inverse_depth_from_index(torch.tensor([8.0, 16.0]), num_hypotheses=17, min_depth=0.5)
        tensor([1.0000, 2.0000])
    """
    check_hypotheses(num_hypotheses, min_depth)
    index = index.to(torch.promote_types(index.dtype, torch.float32))
    index = index.clamp(0.0, _MAX_INDEX)  # two floats: converters to ONNX want them alike
    return index * (1 / ((num_hypotheses - 1) * min_depth)) + INVERSE_DEPTH_OFFSET


def depth_from_index(
    index: Num[Tensor, "*batch"], num_hypotheses: int, min_depth: float
) -> Float[Tensor, "*batch"]:
    """Return the depth in metres, positive and finite, of (fractional) hypothesis indices ``(*)``.

    Computed in float32 at least; a NaN stays one.

    Examples:
        >>> depth_from_index(torch.tensor([8.0, 16.0]), num_hypotheses=17, min_depth=0.5)
        tensor([1.0000, 0.5000])
    """
    return inverse_depth_from_index(index, num_hypotheses, min_depth).reciprocal()


@check_shapes
def index_from_inverse_depth(
    inverse_depth: Float[Tensor, "*batch"], num_hypotheses: int, min_depth: float
) -> Float[Tensor, "*batch"]:
    """Return the fractional hypothesis index ``(*)`` of inverse depths in 1/m; infinity (0 1/m) has index 0.

    Depths below ``min_depth`` have indices above ``N - 1``; they are not clamped, so that a mask can leave
    them out. Computed in float32 at least, and returned so.

    Examples:
        >>> index_from_inverse_depth(torch.tensor([0.0, 1.0, 2.0]), num_hypotheses=17, min_depth=0.5)
        tensor([ 0.0000,  8.0000, 16.0000])
    """
    check_hypotheses(num_hypotheses, min_depth)
    inverse_depth = in_single_precision(inverse_depth)
    return (inverse_depth - INVERSE_DEPTH_OFFSET).clamp(min=0) * ((num_hypotheses - 1) * min_depth)


@check_shapes
def index_from_depth(
    depth: Float[Tensor, "*batch"], num_hypotheses: int, min_depth: float
) -> Float[Tensor, "*batch"]:
    """Return the fractional hypothesis index ``(*)`` of depths in metres; an infinite depth has index 0.

    Computed in float32 at least, and returned so.

    Examples:
        >>> index_from_depth(torch.tensor([torch.inf, 1.0, 0.5]), num_hypotheses=17, min_depth=0.5)
        tensor([ 0.0000,  8.0000, 16.0000])
    """
    depth = in_single_precision(depth)
    return index_from_inverse_depth(depth.reciprocal(), num_hypotheses, min_depth)
