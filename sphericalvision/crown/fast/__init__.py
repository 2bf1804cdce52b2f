# SPDX-License-Identifier: Apache-2.0
"""The operators of the crown: a readable function each, and the bodies that exist for speed.

=====================  ==============================================================================================
``lookups``            few large operators of torch, and kernels in Triton behind them
``slices``             copies of whole edges, and channels fastest in memory, on a CPU
``cpp``                operators in C++, on a CPU
``convolution``        2D and 3D convolutions with a seventh to a third of the multiplications, as operators of torch
``normalization``      normalisation and ReLU in two passes over memory each way, and within the convolution after them
``registering``        functions as operators of torch; gradients of gradients, by plain formulas
``build``              compiling beside the work, and the cache
=====================  ==============================================================================================
"""

from __future__ import annotations

from torch import Tensor

from sphericalvision.crown import hexagons, places, statistics, taps
from sphericalvision.crown.fast import cpp, lookups, slices
from sphericalvision.crown.fast.cpp import mode_in_use as mode_in_use
from sphericalvision.crown.fast.cpp import recomputation_pays as recomputation_pays
from sphericalvision.crown.statistics import CrownNorm, Pair
from sphericalvision.kernels import Operator


def _convolve_vertices(
    values: Tensor, weight: Tensor, bias: Tensor | None = None, stride: int = 1, relu: bool = False
) -> Pair:
    return convolve_rectangles(*unfold(values), weight, bias, stride, relu)


def _normalize_and_convolve(
    col: Tensor, row: Tensor, norm: CrownNorm, relu: bool, weight: Tensor, bias: Tensor | None
) -> Pair:
    return convolve_rectangles(*normalize(col, row, norm, relu), weight, bias)


unfold = Operator(places.values_at_places, cpu=slices.unfold, fused=lookups.unfold)
fold = Operator(places.mean_over_places, cpu=slices.fold, fused=lookups.fold)
convolve_rectangles = Operator(
    taps.convolve_rectangles,
    cpp=cpp.convolve_rectangles,
    triton=lookups.convolve_with_border_in_triton,
    fused=lookups.convolve_with_joined_border,
    differentiable_triton=True,
)
convolve_vertices = Operator(_convolve_vertices, cpp=cpp.convolve_vertices)
normalize = Operator(statistics.normalize, cpp=cpp.normalize_and_convolve, fused=lookups.normalize)
normalize_and_convolve = Operator(_normalize_and_convolve, cpp=cpp.normalize_and_convolve)
hex_convolve = Operator(
    hexagons.hexagons,
    cpp=cpp.convolve_hexagons,
    triton=lookups.hexagons_in_triton,
    cpu=slices.convolve_hexagons,
    fused=lookups.hexagons2d,
)
