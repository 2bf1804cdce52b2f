# SPDX-License-Identifier: Apache-2.0
"""Sweep tables of the rigs met before: making them again costs as much as a tenth of a training step."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.cameras.fingerprint import rig_fingerprint
from sphericalvision.core import ArgumentError
from sphericalvision.models import DepthNetwork

BYTES = 1 << 30
"""Bytes of all tables together, at most; one table is kept in any case."""
FIRST_BATCHES = 50
"""Batches in which constants are still being made on a device, which a second stream must not read too early."""


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
        self._met: set[str] = set()
        self._stream: Any = None
        self._batches = 0

    def of(self, rigs: CameraRig | Sequence[CameraRig]) -> Any:
        """Return what ``net.tables`` returns, made only once for equal cameras and poses.

        Args:
            rigs: one for all samples, or those of a batch, as ``collate_samples`` has them: a batched rig or a list.
                Where all are equal, the tables have no batch dimension.
        """
        batch = None
        if isinstance(rigs, CameraRig):
            batch = rigs if rigs.batch_shape else None
            rigs = [rigs] if batch is None else [batch.select(i) for i in range(len(batch.positions))]
        names = [rig_fingerprint(rig, digits=7) for rig in rigs]
        if batch is not None and len(set(names)) > 1 and not self._met.issuperset(names):
            # Rigs that are drawn anew for each sample do not come again: what is kept are those that have.
            self._met.update(names)
            return self._aside(batch)
        return stacked_tables([self._of_one(rig, name) for rig, name in zip(rigs, names, strict=True)])

    def _aside(self, batch: CameraRig) -> Any:
        """Tables of a batch, on a device while it still works on the step before.

        Tables are checked and counted on the host, which would otherwise wait for all that the device has to do.
        """
        device = self.net.device
        with torch.no_grad():
            if device.type != "cuda":
                return self.net.tables(batch)
            current = torch.cuda.current_stream(device)
            self._stream = self._stream or torch.cuda.Stream(device)
            if self._batches < FIRST_BATCHES:
                self._stream.wait_stream(current)
            self._batches += 1
            with torch.cuda.stream(self._stream):
                tables = self.net.tables(batch)
            current.wait_stream(self._stream)
            for tensor in _tensors(tables):
                tensor.record_stream(current)
            return tables

    def _of_one(self, rig: CameraRig, name: str) -> Any:
        key = (str(self.net.device), name)
        tables = self._tables.pop(key, None)
        if tables is None:
            with torch.no_grad():
                tables = self.net.tables(rig)
        self._tables[key] = tables
        while len(self._tables) > 1 and (
            len(self._tables) > self.capacity
            or sum(tensor.nbytes for tensor in _tensors(tuple(self._tables.values()))) > BYTES
        ):
            del self._tables[next(iter(self._tables))]
        return tables


def stacked_tables(parts: Sequence[Any]) -> Any:
    """Stack the tables of single rigs as tables of a batch; as they are if all are the same.

    Raises:
        ArgumentError: they differ in something that a batch has once, such as the size of images.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.models import IcoSweepNet
        >>> net = IcoSweepNet(level=3, num_hypotheses=4, feature_channels=2, num_cameras=2)
        >>> tables = [net.tables(ring_rig(2)), net.tables(ring_rig(2, radius=0.1))]
        >>> stacked_tables(tables).ids.shape
        torch.Size([2, 4, 42, 2, 3])
    """
    first = parts[0]
    if all(part is first for part in parts):
        return first
    if isinstance(first, Tensor):
        return torch.stack(list(parts))
    if isinstance(first, CameraRig):
        return CameraRig.stack(parts)
    if isinstance(first, tuple):
        values = [stacked_tables(values) for values in zip(*parts, strict=True)]
        return type(first)(*values) if hasattr(first, "_fields") else tuple(values)
    if any(part != first for part in parts):
        raise ArgumentError(f"rigs: expected a batch whose images have one size, got {list(parts)}")
    return first


def _tensors(tables: Any) -> list[Tensor]:
    """All tensors in tuples of tuples."""
    if isinstance(tables, tuple):
        return [tensor for part in tables for tensor in _tensors(part)]
    return [tables] if isinstance(tables, Tensor) else []
