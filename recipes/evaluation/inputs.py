# SPDX-License-Identifier: Apache-2.0
"""What each kind of network takes of a sample, and its answer where all kinds are compared: on icospheres."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from sphericalvision.core import ArgumentError
from sphericalvision.icosphere import Icosphere, level_from_num_vertices
from sphericalvision.models import IcoSweepNet, OmniMVS
from sphericalvision.recipes.training.rig_tables import RigTables

__all__ = ["VertexEstimator"]


class VertexEstimator:
    """The hypothesis index ``(B, V)`` that a network of either kind gives at the vertices of a batch's truth.

    Panoramas are interpolated linearly. Where one does not reach, the answer is that of its nearest row.

    Args:
        net: the network.

    Raises:
        ArgumentError: a batch lacks what the network wants.
    """

    def __init__(self, net: IcoSweepNet | OmniMVS) -> None:
        self.net, self.tables = net, RigTables(net.sweep)

    def __call__(self, batch: dict[str, Any]) -> Tensor:
        if isinstance(self.net, IcoSweepNet):
            return self.net(wanted(batch, "images"), batch["rig"])  # type: ignore[no-any-return]
        panorama = self.net(wanted(batch, "fisheye"), self.tables.of(batch["rig"]))
        level = level_from_num_vertices(wanted(batch, "inverse_depth").shape[-1])
        return self.net.index_at(panorama, Icosphere(level, device=panorama.device).vertices)[0]

    def reaches(self, directions: Tensor) -> Tensor:
        """Where the network says anything, ``(V,)`` of directions ``(V, 3)``."""
        if isinstance(self.net, OmniMVS):
            return self.net.grid.contains(directions)
        return torch.ones(len(directions), dtype=torch.bool, device=directions.device)


def wanted(batch: dict[str, Any], key: str) -> Tensor:
    """An entry of a batch, or an error that says which data have it."""
    if key in batch:
        return batch[key]  # type: ignore[no-any-return]
    raise ArgumentError(
        f"data: the entry '{key}' is wanted, samples hold {', '.join(batch)}; for OmniMVS take data=fisheye_scenes or "
        "another set with data.entries=[sphere,fisheye]"
    )
