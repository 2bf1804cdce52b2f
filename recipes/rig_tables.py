# SPDX-License-Identifier: Apache-2.0
"""Sweep tables of the rigs met so far: making them anew costs as much as a tenth of a training step."""

from __future__ import annotations

from collections import OrderedDict

import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.sweep import SphereSweep, SweepTables

__all__ = ["RigTables"]


class RigTables:
    """The tables of the rigs used last; training on one rig, turned by multiples of 72 degrees, meets five.

    Args:
        sweep: what they are tables of.
        capacity: how many to keep.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> tables = RigTables(SphereSweep(level=1, num_hypotheses=4, min_depth=0.5))
        >>> tables.of(ring_rig(2)) is tables.of(ring_rig(2))
        True
    """

    def __init__(self, sweep: SphereSweep, capacity: int = 16) -> None:
        self.sweep, self.capacity = sweep, capacity
        self._tables: OrderedDict[tuple[bytes | str, ...], SweepTables] = OrderedDict()

    def of(self, rig: CameraRig) -> SweepTables:
        """Return what ``sweep.tables(rig)`` returns, made only once for equal poses and fields of view."""
        device = str(self.sweep.directions.device)
        key = (device, _bytes(rig.world_from_camera), _bytes(torch.as_tensor(rig.max_angles)))
        if key not in self._tables:
            with torch.no_grad():
                self._tables[key] = self.sweep.tables(rig)
        self._tables.move_to_end(key)
        while len(self._tables) > self.capacity:
            self._tables.popitem(last=False)
        return self._tables[key]


def _bytes(values: Tensor) -> bytes:
    """Poses that differ by rounding alone are one pose."""
    return (values.detach().cpu().double() * 1e6).round().long().numpy().tobytes()
