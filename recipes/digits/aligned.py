# SPDX-License-Identifier: Apache-2.0
"""An experiment on why ``CrownConv2d`` lags: taps that point the same way in columns and rows."""

from typing import Any

from sphericalvision.crown import Crown, CrownConv2d
from sphericalvision.crown.taps import convolve, planar_kernels, repeat_border
from sphericalvision.models.classifier import SphereClassifier


class AlignedCrownConv2d(CrownConv2d):
    """``CrownConv2d`` with the taps of columns in rows, too.

    A row rectangle consists of halves of two columns whose axes it keeps, so that equal places in the kernel are
    equal directions on the sphere. ``CrownConv2d`` turns the kernel by a sixth of a turn between the two.
    """

    def forward(self, crown: Crown) -> Crown:
        kernel, _ = planar_kernels(self.weight)
        col, row = (
            convolve(repeat_border(part.flatten(0, 1)), kernel, self.bias, self.stride).unflatten(0, (-1, 5))
            for part in crown
        )
        return Crown(col, row)


class AlignedCrownClassifier(SphereClassifier):
    """``SphereClassifier("crown")`` with ``AlignedCrownConv2d``; parameters and first weights are the same."""

    def __init__(self, network: str = "crown", *args: Any, **kwargs: Any) -> None:
        super().__init__(network, *args, **kwargs)
        for name, layer in list(self.named_modules()):
            if isinstance(layer, CrownConv2d):
                out_channels, in_channels, _ = layer.weight.shape
                aligned = AlignedCrownConv2d(in_channels, out_channels, layer.stride)
                aligned.weight = layer.weight
                self.set_submodule(name, aligned)
