# SPDX-License-Identifier: Apache-2.0
"""Depth of frame after frame: some are read ahead, and on a CPU several are estimated side by side."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

from sphericalvision.capture.depth import Depth
from sphericalvision.capture.predictor import Predictor
from sphericalvision.capture.sources.frames import Frame, Selection, Source
from sphericalvision.capture.sources.threads import ahead, side_by_side, threads_kept

__all__ = ["Estimate", "estimate_frames"]

MOST_WORKERS = 4
"""Frames that are estimated at once, each in memory of its own."""


class Estimate(NamedTuple):
    """A frame and its depth.

    Attributes:
        frame: as it came.
        depth: None where the images could not be read, or nobody wants it any more.
        seconds: that the network was busy, as a share of all that is estimated side by side.
    """

    frame: Frame
    depth: Depth | None
    seconds: float = 0.0


def estimate_frames(
    source: Source,
    selection: Selection,
    predictor: Predictor,
    wanted: Callable[[str], bool] = lambda name: True,
    number: int | None = None,
) -> Iterator[Estimate]:
    """Yield the depth of the frames chosen that are wanted, in their order, while a thread reads the next ones.

    On a CPU as many frames as torch has threads, up to four, are estimated side by side.

    Args:
        source: of the frames.
        selection: which of them.
        predictor: of their depth.
        wanted: asked by a frame's name before it is read, and again before it is estimated.
        number: of the frames, where that is known.
    """

    def estimate(frame: Frame) -> Estimate:
        if frame.images is None or not wanted(frame.name):
            return Estimate(frame, None)
        start = time.perf_counter()
        depth = (predictor if frame.rig is None else predictor.with_rig(frame.rig))(frame.images)
        return Estimate(frame, depth, (time.perf_counter() - start) / workers)

    frames = ahead(source.frames(selection, wanted), newest=source.live)
    with threads_kept() as threads:
        most = MOST_WORKERS if number is None else min(MOST_WORKERS, max(1, number))
        workers = min(threads, most) if predictor.device.type == "cpu" else 1
        estimated = side_by_side(estimate, frames, workers, threads // workers)
        try:
            yield from estimated
        finally:
            estimated.close()  # type: ignore[attr-defined]
            frames.close()  # type: ignore[attr-defined]
