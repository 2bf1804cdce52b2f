# SPDX-License-Identifier: Apache-2.0
"""The original authors' network, its tables, inputs and outputs, in our order of vertices."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from sphericalvision.icosphere import Icosphere
from sphericalvision.sweep import SweepTables


@dataclass(frozen=True)
class Reference:
    """Level 4 to 2, N = 8, batch 2, four cameras of 220°."""

    folder: Path
    state_dict: dict[str, Tensor]
    numbers: dict[str, Any]

    @property
    def images(self) -> Tensor:
        cameras = [self.numbers["input"][f"cam{k}"].squeeze(2) for k in range(1, 5)]
        return torch.stack(cameras, 1)[..., Icosphere(4).subdivision_order]

    def vertices(self, name: str) -> Tensor:
        """Return a result ``(..., 162)`` in our order of vertices."""
        return self.numbers[name][..., Icosphere(2).subdivision_order]

    def tables(self, level: int) -> SweepTables:
        """Return what the reference looks up: the three nearest vertices, with ratios of areas as weights."""
        sweep = np.load(self.folder / "sweep.npz")

        def cameras(name: str) -> Tensor:
            return torch.stack([torch.tensor(sweep[f"{name}_l{level}_cam{k}"]) for k in range(1, 5)])[
                ..., order
            ]

        order = Icosphere(level).subdivision_order
        ours = torch.empty_like(order)
        ours[order] = torch.arange(len(order))
        mask = cameras("inside").permute(1, 2, 0)
        weights = cameras("w").permute(1, 3, 0, 2) * mask[..., None]
        return SweepTables(ours[cameras("ids").long()].permute(1, 3, 0, 2), weights, mask)

    @property
    def poses(self) -> Tensor:
        """World from camera, ``(4, 4, 4)`` in metres."""
        return torch.linalg.inv(torch.tensor(np.load(self.folder / "sweep.npz")["poses_cw"]))


@pytest.fixture(scope="session")
def reference(golden: Path) -> Reference:
    state_dict = torch.load(golden / "state_dict.pt", weights_only=True)
    return Reference(golden, state_dict, torch.load(golden / "net_level4_depth2_n8.pt", weights_only=True))


@pytest.fixture
def write_checkpoint(tmp_path: Path) -> Callable[..., Path]:
    """Write a dictionary as the authors' release does, and return the path."""

    def write(**entries: object) -> Path:
        torch.save(entries, tmp_path / "checkpoint.pth")
        return tmp_path / "checkpoint.pth"

    return write
