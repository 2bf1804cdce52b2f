# SPDX-License-Identifier: Apache-2.0
"""Sweep tables of the rigs met so far: making them anew costs as much as a tenth of a training step."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.cameras.fingerprint import rig_fingerprint
from sphericalvision.models import DepthNetwork

__all__ = ["RigTables"]

BYTES = 1 << 30
"""How much the tables kept may weigh together; at least one is kept."""


class RigTables:
    """The tables of the rigs used last; training on one rig, turned by multiples of 72 degrees, meets five.

    Args:
        net: whose tables they are.
        capacity: how many to keep.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.models import IcoSweepNet
        >>> tables = RigTables(IcoSweepNet(level=3, num_hypotheses=4, feature_channels=2, num_cameras=2))
        >>> tables.of(ring_rig(2)) is tables.of(ring_rig(2))
        True
    """

    def __init__(self, net: DepthNetwork, capacity: int = 16) -> None:
        self.net, self.capacity = net, capacity
        self._tables: dict[tuple[str, str], Any] = {}  # the one used last at the end

    def of(self, rig: CameraRig) -> Any:
        """Return what ``net.tables(rig)`` returns, made only once for equal cameras and poses."""
        key = (str(self.net.device), rig_fingerprint(rig, digits=7))
        tables = self._tables.pop(key, None)
        if tables is None:
            with torch.no_grad():
                tables = self.net.tables(rig)
        self._tables[key] = tables
        while len(self._tables) > 1 and (
            len(self._tables) > self.capacity or _bytes(tuple(self._tables.values())) > BYTES
        ):
            del self._tables[next(iter(self._tables))]
        return tables


def _bytes(tables: Any) -> int:
    """How much tensors in tuples of tuples weigh."""
    if isinstance(tables, Tensor):
        return tables.nbytes
    return sum(map(_bytes, tables)) if isinstance(tables, tuple) else 0
