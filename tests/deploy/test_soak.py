# SPDX-License-Identifier: Apache-2.0
"""Ten thousand frames through one predictor: memory stays flat, and the last answer is the first."""

from __future__ import annotations

import gc
import os
from pathlib import Path

import pytest
import torch

from sphericalvision.cameras import ring_rig
from sphericalvision.data import make_scene, render_rig
from sphericalvision.deploy import Predictor

FRAMES = int(os.environ.get("SPHERICALVISION_FRAMES", "10000"))
MOST_GROWTH = 16 * 2**20


def resident() -> int:
    """Bytes of this process in memory."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is read from /proc")
def test_memory_is_flat() -> None:
    rig = ring_rig(3, image_size=(16, 16))
    scenes = [render_rig(make_scene("bare", seed=seed), rig) for seed in range(3)]
    predictor = Predictor(rig, method="semi_global", level=3, num_hypotheses=4, min_depth=0.5)
    first = predictor(scenes[0]).depth
    for frame in range(FRAMES // 10):  # everything has been allocated once
        predictor(scenes[frame % 3])
    before = resident()
    for frame in range(FRAMES):
        depth = predictor(scenes[frame % 3])
        if frame % 500 == 0:
            depth.points()
            depth.panorama(8)
    assert resident() - before < MOST_GROWTH
    assert torch.equal(predictor(scenes[0]).depth, first)
