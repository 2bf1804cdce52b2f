# SPDX-License-Identifier: Apache-2.0
"""Tables of a network are made once a rig."""

from __future__ import annotations

import math

import pytest
import torch

from sphericalvision.cameras import ring_rig
from sphericalvision.models import IcoSweepNet, SemiGlobalSweep
from sphericalvision.recipes.training.rig_tables import RigTables


def test_tables_are_those_of_the_rig_and_made_once() -> None:
    net = IcoSweepNet(level=3, num_hypotheses=4, min_depth=0.5, feature_channels=2, num_cameras=2)
    tables = RigTables(net, capacity=2)
    rigs = [ring_rig(2), ring_rig(2, radius=0.1), ring_rig(2, field_of_view=math.pi)]
    first = tables.of(rigs[0])
    for rig in rigs:
        for mine, fresh in zip(tables.of(rig), net.tables(rig), strict=True):
            assert torch.equal(mine, fresh)
    assert tables.of(rigs[2]) is tables.of(ring_rig(2, field_of_view=math.pi))
    assert tables.of(rigs[0]) is not first  # the oldest made room


def test_tables_within_tables_count_against_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of a sweep without training hold those of the sphere sweep."""
    monkeypatch.setattr("sphericalvision.recipes.training.rig_tables.BYTES", 1)
    tables = RigTables(SemiGlobalSweep(level=3, num_hypotheses=4))
    first = tables.of(ring_rig(2))
    tables.of(ring_rig(3))  # too heavy to stay beside the first
    assert tables.of(ring_rig(2)) is not first
