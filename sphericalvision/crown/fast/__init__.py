# SPDX-License-Identifier: Apache-2.0
"""What exists for speed alone; the rest of ``crown`` enters by ``door`` and works without.

========================  ==========================================================================================
``door``, ``policy``      what the layers ask, and when fast ways may step in
``layout``                crowns by slices
``planar``                2D convolutions that keep no borders for the backward pass
``winograd``              3D convolutions with a third of the multiplications, upon ``winograd_rows``
``hex_native``            2D and 3D convolutions with a third to a seventh of them, by operators in C++ (``native``)
``chain``, ``block``      two layers from vertices to vertices, for inference and for training, by ``rectangles``
``block_parts``           what both passes of ``block`` share
``norms``                 normalisation folded into a convolution, or rectified in place
``double_backward``       gradients of gradients, by the reference
``workspace``             memory kept between calls
========================  ==========================================================================================
"""

from sphericalvision.crown.fast.door import (
    block3d,
    conv,
    conv_charts,
    conv_norm,
    fold,
    native_at_hand,
    native_operators,
    unfold,
    wherever_possible,
)

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
