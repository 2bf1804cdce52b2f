# SPDX-License-Identifier: Apache-2.0
"""``DepthHint``: depth that is known before a network sees the images."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.core import ShapeError, check_floating, check_tensor, check_type
from sphericalvision.icosphere import level_from_num_vertices
from sphericalvision.sweep.ring_mean import ids_of_coarser_level, ring_mean


class DepthHint(NamedTuple):
    """Depth of some directions on a network's icosphere, from a LiDAR, a monocular network or the last frame.

    It may be wrong: a network weighs it against the images.

    Attributes:
        inverse_depth: ``(B, V)`` in 1/m from the rig's centre, 0 is infinity; any number where the weight is 0.
        weight: ``(B, V)`` trust, 0 to 1; 0 where nothing is known.

    Examples:
        >>> hint = DepthHint(torch.full((1, 162), 0.5), torch.zeros(1, 162))
        >>> hint.weight[0, 0] = 0.8
        >>> coarser = hint.coarser()
        >>> coarser.weight.shape, coarser.weight.sum()
        (torch.Size([1, 42]), tensor(0.8000))
    """

    inverse_depth: Float[Tensor, "B V"]
    weight: Float[Tensor, "B V"]

    def coarser(self) -> DepthHint:
        """Return the hint on the next coarser icosphere: the vertex's own, or the mean of its neighbours'."""
        level = level_from_num_vertices(self.weight.shape[-1])
        inverse_depth = self.inverse_depth.where(self.weight > 0, 0.0)
        values = torch.stack((inverse_depth * self.weight, self.weight * self.weight, self.weight), -1)
        sums = ring_mean(values.transpose(0, 1), level - 1).transpose(0, 1)
        around = DepthHint(*(sums[..., :2] / sums[..., 2:].clamp(min=1e-6)).unbind(-1))
        ids = ids_of_coarser_level(level, level - 1, self.weight.device)
        known = self.weight[:, ids] > 0
        return DepthHint(*(own[:, ids].where(known, mean) for own, mean in zip(self, around, strict=True)))


def check_hint(hint: DepthHint, shape: tuple[int, ...]) -> None:
    """Raise ``ShapeError`` unless a hint has a shape ``(B, *grid)``."""
    check_type("hint", hint, DepthHint, "DepthHint(inverse_depth, weight) on the network's icosphere")
    for name, values in zip(("inverse_depth", "weight"), hint, strict=True):
        check_tensor(f"hint.{name}", values, "(B, V)")
        check_floating(f"hint.{name}", values)
        if tuple(values.shape) != shape:
            raise ShapeError(
                f"hint.{name}: expected shape {shape}, a number for each sample and vertex, "
                f"got {tuple(values.shape)}"
            )
