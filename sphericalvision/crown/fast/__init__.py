# SPDX-License-Identifier: Apache-2.0
"""Operators in C++ for CPUs; the rest of ``crown`` enters by ``door`` and works without.

=====================  ==============================================================================================
``door``               what the layers ask, and when operators step in
``convolution``        2D and 3D convolutions with a seventh to a third of the multiplications, as operators of torch
``normalization``      normalisation and ReLU in two passes over memory each way, as an operator of torch
``double_backward``    gradients of gradients, by the reference
``build``              compiling beside the work, and the cache
=====================  ==============================================================================================
"""

from sphericalvision.crown.fast.door import convolve_rectangles, normalize, settled_way

__all__ = ["convolve_rectangles", "normalize", "settled_way"]
