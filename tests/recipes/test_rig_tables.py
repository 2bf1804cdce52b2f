# SPDX-License-Identifier: Apache-2.0
"""Sweep tables are made once a rig."""

from __future__ import annotations

import math

import torch

from sphericalvision.cameras import ring_rig
from sphericalvision.recipes.training.rig_tables import RigTables
from sphericalvision.sweep import SphereSweep


def test_tables_are_those_of_the_rig_and_made_once() -> None:
    sweep = SphereSweep(level=1, num_hypotheses=4, min_depth=0.5)
    tables = RigTables(sweep, capacity=2)
    rigs = [ring_rig(2), ring_rig(2, radius=0.1), ring_rig(2, field_of_view=math.pi)]
    first = tables.of(rigs[0])
    for rig in rigs:
        for mine, fresh in zip(tables.of(rig), sweep.tables(rig), strict=True):
            assert torch.equal(mine, fresh)
    assert tables.of(rigs[2]) is tables.of(ring_rig(2, field_of_view=math.pi))
    assert tables.of(rigs[0]) is not first  # the oldest made room
