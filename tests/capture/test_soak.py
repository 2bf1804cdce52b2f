# SPDX-License-Identifier: Apache-2.0
"""Ten thousand frames through one predictor, and through the stream of the command: memory stays flat.

``SPHERICALVISION_FRAMES=1000`` makes it a matter of seconds. Memory on the way is printed (``pytest -rP``).
"""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.capture import Predictor
from sphericalvision.capture.outputs import Outputs
from sphericalvision.capture.result_folder import Settings
from sphericalvision.capture.sources.frames import Frame, Recording, Selection
from sphericalvision.capture.sources.moments import Moments
from sphericalvision.models import SemiGlobalSweep
from sphericalvision.recipes.commands.predict import run
from sphericalvision.scenes import make_scene, render_rig

FRAMES = int(os.environ.get("SPHERICALVISION_FRAMES", "10000"))
MOST_GROWTH = 16 * 2**20

needs_proc = pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is read from /proc")
Images = dict[str, torch.Tensor]


class Watch:
    """Bytes of this process in memory at the first, tenth, hundredth, ... time it is looked at."""

    def __init__(self) -> None:
        self.count, self.seen = 0, dict[int, int]()

    def look(self) -> None:
        self.count += 1
        if self.count in (10, 100, 1000, 10_000, 100_000, 1_000_000, FRAMES):
            gc.collect()
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            self.seen[self.count] = pages * os.sysconf("SC_PAGE_SIZE")

    @property
    def growth(self) -> int:
        """From a tenth of the frames, when everything has been allocated once, to the end."""
        print("MB after frames:", {count: round(size / 2**20, 1) for count, size in self.seen.items()})
        return self.seen[FRAMES] - max(size for count, size in self.seen.items() if count <= FRAMES // 10)


@pytest.fixture(scope="module")
def rig() -> CameraRig:
    return ring_rig(3, image_size=(16, 16))


@pytest.fixture(scope="module")
def scenes(rig: CameraRig) -> list[Images]:
    return [render_rig(make_scene("bare", seed=seed), rig) for seed in range(3)]


def small_predictor(rig: CameraRig) -> Predictor:
    return Predictor(rig, SemiGlobalSweep(3, 4, depth_coarsening=1), min_depth=0.5)


@pytest.mark.slow
@needs_proc
def test_memory_is_flat(rig: CameraRig, scenes: list[Images]) -> None:
    predictor, watch = small_predictor(rig), Watch()
    first = predictor(scenes[0]).depth
    for frame in range(FRAMES):
        depth = predictor(scenes[frame % 3])
        if frame % 500 == 0:
            depth.points()
            depth.panorama(8)
        watch.look()
    assert watch.growth < MOST_GROWTH
    assert torch.equal(predictor(scenes[0]).depth, first)


class Endless(Recording):
    """A source of as many frames as one likes."""

    def __init__(self, rig: CameraRig, scenes: list[Images], number: int, look: Callable[[], Any]) -> None:
        self.look = look
        super().__init__(Moments({str(n): scenes[n % 3] for n in range(number)}, None, None, "", []), rig)

    @contextmanager
    def opened(self) -> Iterator[Callable[[str, Any], Any]]:
        yield lambda camera, image: image

    def frames(self, selection: Selection, wanted: Callable[[str], bool]) -> Iterator[Frame]:
        for frame in super().frames(selection, wanted):
            self.look()
            yield frame


@needs_proc
@pytest.mark.parametrize("number", [12, pytest.param(FRAMES, marks=pytest.mark.slow)])
def test_memory_of_the_stream_is_flat(
    number: int, rig: CameraRig, scenes: list[Images], tmp_path: Path
) -> None:
    """Frames are read ahead and written behind in threads; nothing waits for ever, and nothing piles up."""
    watch = Watch()
    outputs = Outputs(tmp_path, Settings([], height=8))
    source = Endless(rig, scenes, number, watch.look)
    assert run(source, Selection(), small_predictor(rig), outputs, None) == []
    assert outputs.count == number
    assert number < FRAMES or watch.growth < MOST_GROWTH
