# SPDX-License-Identifier: Apache-2.0
"""``sphericalvision-study preset=benchmark``: methods by tracks, in processes; or one network on one track."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import torch
from joblib import Parallel, delayed
from omegaconf import DictConfig

from sphericalvision.capture.estimating import threads_kept
from sphericalvision.capture.preparation.preparation import Preparation
from sphericalvision.core import FileFormatError
from sphericalvision.io.images import write_image
from sphericalvision.models import DepthNetwork
from sphericalvision.recipes.app.cli import console
from sphericalvision.recipes.evaluation.loop import evaluate, records_of
from sphericalvision.recipes.evaluation.methods import SCALE, Method, make_methods
from sphericalvision.recipes.evaluation.pictures import DrawnFrame, Picture, color_picture
from sphericalvision.recipes.evaluation.places import FrameTruth, PlaceErrors
from sphericalvision.recipes.evaluation.records import Record, read_json, write_json
from sphericalvision.recipes.evaluation.track_frames import NATURAL_SIZE, Size, TrackFrames
from sphericalvision.recipes.evaluation.tracks import TRACKS, Track, chosen_tracks
from sphericalvision.recipes.study.benchmark_tables import Results, report
from sphericalvision.viz import sheet
from sphericalvision.viz.panorama import icosphere_to_panorama

__all__ = ["compare", "run_track", "scores"]


def compare(config: DictConfig, folder: Path) -> dict[str, dict[str, Record]]:
    """Measure what is missing, write tables and pictures; returns the records by track and method."""
    node = config.benchmark
    preparation = Preparation(node.photometric, node.align)
    size = Size(node.level, node.panorama_rows, node.image_rows, node.samples_per_pixel, preparation)
    numbers = range(node.first_frame, node.first_frame + node.frames)
    cache = None if node.cache_dir is None else Path(node.cache_dir).absolute()
    words = tuple(map(str, node.methods))
    tracks = chosen_tracks([str(word) for word in node.tracks], [str(mesh) for mesh in node.meshes])
    methods = _methods(words, size.level, folder)
    sets = [TrackFrames(track, numbers, size, cache) for track in tracks]
    console.print(f"{len(tracks)} tracks, {node.frames} scenes each, {len(methods)} methods", highlight=False)
    processes = Parallel(n_jobs=max(1, node.workers), return_as="generator")
    for summary in processes(
        delayed(_measure)(frames, words, folder, config.panel_height) for frames in sets
    ):
        console.print(summary, highlight=False)
    measure = PlaceErrors(size.level)
    results = {
        frames.name: {
            name: record.only(frames.names)
            for name, record in records_of(methods, frames, measure, folder).items()
        }
        for frames in sets
    }
    report(folder, Results(tracks, [method.name for method in methods], results, size.level))
    print(f"Results are in {folder}: benchmark.md, benchmark.json, index.html, pages")
    return results


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
    method = Method("network", network)
    track_frames = TrackFrames(chosen, range(frames), size, None if cache is None else Path(cache))
    return run_track(track_frames, [method], None)["network"].means


def run_track(frames: TrackFrames, methods: Sequence[Method], folder: Path | None) -> Mapping[str, Record]:
    """Score methods on frames of a track, those that are not in ``folder`` yet; the records by method."""
    measure = PlaceErrors(frames.size.level)
    records = records_of(methods, frames, measure, folder)
    with threads_kept():
        torch.set_num_threads(1)  # for times that mean something
        return evaluate(methods, frames, measure, records, count_cost=True)


def _measure(frames: TrackFrames, words: tuple[str, ...], folder: Path, rows: int) -> str:
    """Measure a track and draw its page; returns a line about it."""
    records = run_track(frames, _methods(words, frames.size.level, folder), folder)
    place = folder / "pages" / f"{frames.track.name}.png"
    key = {name: record.key for name, record in records.items()} | {"rows": rows, "frames": frames.drawn}
    if not (place.is_file() and _key_of(place) == key):
        write_image(place, sheet([_drawn(frames, name, records, rows) for name in frames.drawn]))
        write_json(place.with_suffix(".json"), key)
    means = {
        name: record.only(frames.names).means["coarse"]["all"]["MAE"] for name, record in records.items()
    }
    shown = (f"{name} {'–' if mean is None else f'{mean:.2f}'}" for name, mean in means.items())
    return f"{frames.track.name}: MAE {', '.join(shown)}"


def _drawn(frames: TrackFrames, name: str, records: Mapping[str, Record], rows: int) -> Picture:
    """A camera as methods get it, what there is to see, the truth, depth by method, and errors."""
    frame = frames.frame(name)
    truth = FrameTruth(frame)
    camera = frame.rig.names[0]
    image = color_picture(frame.images[camera] * frame.rig.masks.get(camera, torch.tensor(1.0)))
    width = min(2 * rows, round(rows * image.shape[1] / image.shape[0]))
    drawn = DrawnFrame(
        color_picture(icosphere_to_panorama(frame.colors, rows)),
        truth.index.where(truth.valid, torch.nan),
        truth.regions["all"],
        {method: record.drawn[name] for method, record in records.items()},
        SCALE,
    )
    small = cv2.resize(image, (width, rows), interpolation=cv2.INTER_AREA)
    depths = drawn.depths()
    pictures = {"first camera": small, name: depths.pop("view"), **depths, **drawn.errors()}
    return sheet(pictures, columns=3)


def _key_of(page: Path) -> object:
    try:
        return read_json(page.with_suffix(".json"))
    except (OSError, FileFormatError):
        return None


@lru_cache(maxsize=1)
def _methods(words: tuple[str, ...], level: int, folder: Path) -> list[Method]:
    """Made once in a process."""
    return make_methods(words, level, folder)
