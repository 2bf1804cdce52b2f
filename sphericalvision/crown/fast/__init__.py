# SPDX-License-Identifier: Apache-2.0
"""Operators in C++ for CPUs; the rest of ``crown`` enters by ``door`` and works without.

=====================  ==============================================================================================
``door``               which way the layers go, and the operators that they call
``convolution``        2D and 3D convolutions with a seventh to a third of the multiplications, as operators of torch
``normalization``      normalisation and ReLU in two passes over memory each way, and within the convolution after them
``registering``        functions as operators of torch; gradients of gradients, by plain formulas
``build``              compiling beside the work, and the cache
=====================  ==============================================================================================
"""

from sphericalvision.crown.fast.door import (
    convolve_charts,
    convolve_rectangles,
    convolve_vertices,
    normalize,
    operators_in_use,
    recomputation_pays,
    slices_pay,
)

__all__ = [
    "convolve_charts",
    "convolve_rectangles",
    "convolve_vertices",
    "normalize",
    "operators_in_use",
    "recomputation_pays",
    "slices_pay",
]
