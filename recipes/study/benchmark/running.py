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
from sphericalvision.recipes.study.benchmark.frames import NATURAL_SIZE, Size, aligner, render_frame
from sphericalvision.recipes.study.benchmark.methods import HYPOTHESES, MIN_DEPTH, Method, identity_of
from sphericalvision.recipes.study.benchmark.records import Record
from sphericalvision.recipes.study.benchmark.scoring import FrameTruth, score
from sphericalvision.recipes.study.benchmark.summary import mean_scores
from sphericalvision.recipes.study.benchmark.tracks import TRACKS, Track

__all__ = ["drawn_of", "one_thread", "record_of", "run_track", "scores"]


DRAWN = (0, 3, 4)
"""Places among the frames of those that are drawn; where kinds of scenes take turns a corridor, outdoors and a room."""


def drawn_of(frames: range) -> list[int]:
    """Return the numbers of the frames that are drawn."""
    return [frames[place] for place in DRAWN if place < len(frames)]


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
        Nested dictionaries as ``scoring.score`` has them, means over frames; ``["coarse"]["all"]["MAE"]`` is the MAE
        in percent of N = 16 at the vertices of level 4, ``["fine"]`` that at level 6; ``["seconds"]`` a frame.

    Examples:
        >>> from sphericalvision.models import WinnerTakesAll
        >>> small = Size(level=3, panorama_rows=8, image_rows=16, samples_per_pixel=1, preparation=AS_IT_IS)
        >>> found = scores(WinnerTakesAll(3, 4), "room", frames=1, cache=None, size=small)
        >>> 0 < found["coarse"]["all"]["MAE"] < 100
        True
    """
    chosen = TRACKS[track] if isinstance(track, str) else track
    method = Method("network", network)
    folder = None if cache is None else Path(cache)
    return mean_scores(run_track(chosen, [method], range(frames), None, folder, size)["network"].scores)


def record_of(track: Track, method: Method, folder: Path | None, size: Size) -> Record:
    """What is there of a method on a track."""
    key = {
        "track": repr(track),
        "method": method.identity,
        "size": {**size._asdict(), "preparation": asdict(size.preparation)},
        "hypotheses": HYPOTHESES,
        "min_depth": MIN_DEPTH,
    }
    if size.preparation != AS_IT_IS:
        key["aligner"] = _aligner_identity()
    if track.carrier is not None:
        key["truth"] = "without the carrier"
    return Record(folder, track.name, method.name, key)


def run_track(
    track: Track,
    methods: Sequence[Method],
    frames: range,
    folder: Path | None,
    cache: Path | None = None,
    size: Size = NATURAL_SIZE,
) -> Mapping[str, Record]:
    """Score methods on frames of a track, by their numbers, those that are not in ``folder`` yet.

    Returns:
        Method's name -> its record.
    """
    records = {method.name: record_of(track, method, folder, size) for method in methods}
    with one_thread():
        for number in frames:
            name = track.frame_name(number)
            drawn = number in drawn_of(frames)
            missing = [
                method for method in methods if not records[method.name].has(name, number if drawn else None)
            ]
            if not missing:
                continue
            frame = render_frame(track, number, size, cache)
            truth = FrameTruth(frame)
            for method in missing:
                said, record = method(frame), records[method.name]
                found = {"seconds": said.seconds, **score(method.net, said, truth)}
                if drawn:
                    record.draw(number, truth.index_of(method.net, said.estimate.index))
                cost = method.cost(frame)._asdict() if record.cost is None else None
                record.add(name, found, cost)
    return records


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
