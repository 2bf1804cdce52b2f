# SPDX-License-Identifier: Apache-2.0
"""Methods through tracks: frame by frame, what is missing of each; and one network on one track, as a function."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from sphericalvision.capture.preparation.preparation import AS_IT_IS
from sphericalvision.models import DepthNetwork
from sphericalvision.recipes.evaluation.loop import evaluate
from sphericalvision.recipes.evaluation.methods import Method, identity_of
from sphericalvision.recipes.evaluation.records import Record
from sphericalvision.recipes.study.comparison.frames import (
    NATURAL_SIZE,
    Frame,
    Size,
    aligner,
    render_frame,
)
from sphericalvision.recipes.study.comparison.methods import SCALE, frame_inputs
from sphericalvision.recipes.study.comparison.places import PlaceErrors
from sphericalvision.recipes.study.comparison.tracks import TRACKS, Track

__all__ = ["TrackFrames", "one_thread", "record_of", "run_track", "scores"]

GENERATION = 2
"""Raised whenever a frame would be scored otherwise, so that old records are not taken."""

DRAWN = (0, 3, 4)
"""Places among the frames of those that are drawn; where kinds of scenes take turns a corridor, outdoors and a room."""


class TrackFrames:
    """Frames of a track, each rendered when it is asked for.

    Args:
        track: which.
        numbers: of the frames.
        size: how fine.
        cache: folder of renderings.
    """

    def __init__(self, track: Track, numbers: range, size: Size, cache: Path | None) -> None:
        self.track, self.size, self.cache = track, size, cache
        self.numbers = {track.frame_name(number): number for number in numbers}
        self.names = list(self.numbers)
        self.drawn = [self.names[place] for place in DRAWN if place < len(self.names)]

    def frame(self, name: str) -> Frame:
        """Render a frame."""
        return render_frame(self.track, self.numbers[name], self.size, self.cache)

    def batches(self, names: Sequence[str]) -> Iterator[tuple[Sequence[str], Frame]]:
        """Each frame by itself."""
        for name in names:
            yield [name], self.frame(name)


def scores(
    network: DepthNetwork,
    track: str | Track,
    frames: int = 7,
    cache: str | Path | None = "outputs/scene_cache",
    size: Size = NATURAL_SIZE,
) -> dict[str, Any]:
    """Mean scores of one network on one track.

    Args:
        network: any ``DepthNetwork``; put in evaluation mode.
        track: its name, one of ``TRACKS``.
        frames: number of scenes.
        cache: folder of renderings, so that the next call costs little.
        size: how fine frames are.

    Returns:
        Nested dictionaries as ``PlaceErrors`` has them, means over frames; ``["coarse"]["all"]["MAE"]`` is the MAE
        in percent of N = 16 at the vertices of level 4, ``["fine"]`` that at level 6; ``["seconds"]`` a frame.

    Examples:
        >>> from sphericalvision.models import WinnerTakesAll
        >>> small = Size(level=3, panorama_rows=8, image_rows=16, samples_per_pixel=1, preparation=AS_IT_IS)
        >>> found = scores(WinnerTakesAll(3, 4), "room", frames=1, cache=None, size=small)
        >>> 0 < found["coarse"]["all"]["MAE"] < 100
        True
    """
    chosen = TRACKS[track] if isinstance(track, str) else track
    method = Method("network", network, inputs=frame_inputs)
    given = TrackFrames(chosen, range(frames), size, None if cache is None else Path(cache))
    return run_track(given, [method], None)["network"].means


def record_of(track: Track, method: Method, folder: Path | None, size: Size) -> Record:
    """What is there of a method on a track."""
    key = {
        "generation": GENERATION,
        "track": repr(track),
        "method": identity_of(method.net),
        "size": {**size._asdict(), "preparation": asdict(size.preparation)},
        "hypotheses": list(SCALE),
    }
    if size.preparation != AS_IT_IS:
        key["aligner"] = _aligner_identity()
    return Record(None if folder is None else folder / "records" / track.name / f"{method.name}.json", key)


def run_track(frames: TrackFrames, methods: Sequence[Method], folder: Path | None) -> Mapping[str, Record]:
    """Score methods on frames of a track, those that are not in ``folder`` yet; the records by method."""
    size = frames.size
    records = {method.name: record_of(frames.track, method, folder, size) for method in methods}
    with one_thread():
        return evaluate(methods, frames, PlaceErrors(size.level), records, count_cost=True)


@lru_cache(maxsize=1)
def _aligner_identity() -> str:
    return identity_of(aligner())


@contextmanager
def one_thread() -> Iterator[None]:
    """One thread of torch, for times that mean something."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
