# SPDX-License-Identifier: Apache-2.0
"""The answer of any depth network where all are compared: at the vertices of an icosphere."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from sphericalvision.icosphere import Icosphere, level_from_num_vertices
from sphericalvision.models import DepthNetwork
from sphericalvision.recipes.datamodules.entries import images_of
from sphericalvision.recipes.training.rig_tables import RigTables

__all__ = ["VertexEstimator"]


class VertexEstimator:
    """The hypothesis index ``(B, V)`` that a network gives at the vertices of a batch's truth.

    Between the points of the network's grid it is linear. Where that does not reach, it is that of the nearest point.

    Args:
        net: the network.
    """

    def __init__(self, net: DepthNetwork) -> None:
        self.net, self.tables = net, RigTables(net)

    def __call__(self, batch: dict[str, Any]) -> Tensor:
        images, seen = images_of(batch, self.net)
        index: Tensor = self.net(images, self.tables.of(batch["rig"]), seen)
        number = batch["inverse_depth"].shape[-1]
        if index.shape[1:] == (number,):
            return index
        vertices = Icosphere(level_from_num_vertices(number), device=index.device).vertices
        return self.net.index_at(index, vertices)[0]

    def reaches(self, directions: Tensor) -> Tensor:
        """Where the network says anything, ``(V,)`` of directions ``(V, 3)``."""
        nothing = torch.zeros(1, *self.net.grid.shape, device=self.net.device)
        return self.net.index_at(nothing, directions)[1]
