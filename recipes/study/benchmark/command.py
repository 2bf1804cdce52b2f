# SPDX-License-Identifier: Apache-2.0
"""``sphericalvision-study preset=benchmark``: tracks by methods, in processes, and what is written at the end."""

from __future__ import annotations

import json
import multiprocessing
import os
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from functools import lru_cache
from multiprocessing.connection import wait
from pathlib import Path
from typing import NamedTuple

from omegaconf import DictConfig

from sphericalvision.capture.preparation.preparation import Preparation
from sphericalvision.io.images import write_image
from sphericalvision.recipes.app.cli import console, print_table
from sphericalvision.recipes.study.benchmark.frames import Size, render_frame
from sphericalvision.recipes.study.benchmark.methods import Method, make_methods
from sphericalvision.recipes.study.benchmark.pictures import page
from sphericalvision.recipes.study.benchmark.records import Record
from sphericalvision.recipes.study.benchmark.report import report
from sphericalvision.recipes.study.benchmark.running import drawn_of, record_of, run_track
from sphericalvision.recipes.study.benchmark.summary import interval_of
from sphericalvision.recipes.study.benchmark.tables import Measured
from sphericalvision.recipes.study.benchmark.tracks import Track, chosen_tracks
from sphericalvision.recipes.study.training import write_json

__all__ = ["benchmark"]


class Work(NamedTuple):
    """All that a process needs to know, besides the track."""

    methods: tuple[str, ...]
    frames: range
    folder: Path
    cache: Path | None
    size: Size
    panel_rows: int


def benchmark(config: DictConfig, folder: Path) -> dict[str, dict[str, Record]]:
    """Measure what is missing, write tables and pictures; returns the records by track and method."""
    node = config.benchmark
    preparation = Preparation.from_keys(node)
    size = Size(node.level, node.panorama_rows, node.image_rows, node.samples_per_pixel, preparation)
    cache = None if node.cache_dir is None else Path(node.cache_dir).absolute()
    words = tuple(str(word) for word in node.methods)
    frames = range(node.first_frame, node.first_frame + node.frames)
    work = Work(words, frames, folder, cache, size, config.panel_height)
    tracks = chosen_tracks([str(word) for word in node.tracks], [str(mesh) for mesh in node.meshes])
    methods = _methods(words, size.level, folder)
    names = [method.name for method in methods]
    console.print(f"{len(tracks)} tracks, {node.frames} scenes each, {len(names)} methods", highlight=False)
    results: dict[str, dict[str, Record]] = {track.name: {} for track in tracks}
    for track in _run(tracks, work, node.workers):
        said = [track.frame_name(number) for number in frames]
        done = {method.name: record_of(track, method, folder, size).only(said) for method in methods}
        results[track.name] = done
        shown = (f"{k} {interval_of(r.scores, 'coarse', 'all', 'MAE').mean:.2f}" for k, r in done.items())
        console.print(f"{track.name}: MAE {', '.join(shown)}", highlight=False)
    table = report(folder, Measured(tracks, names, results, size.level))[0]
    print_table(table.title, list(table.columns), [list(row) for row in table.rows])
    print(f"Results are in {folder}: benchmark.md, benchmark.json, index.html, pages")
    return results


def _run(tracks: list[Track], work: Work, workers: int) -> Iterator[Track]:
    """The tracks as they are done."""
    if workers == 0:
        for track in tracks:
            _track(track, work)
            yield track
        return
    spawned = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=spawned, initializer=_end_with_parent) as pool:
        jobs = {pool.submit(_track, track, work): track for track in tracks}
        try:
            for job in as_completed(jobs):
                job.result()
                yield jobs[job]
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _track(track: Track, work: Work) -> None:
    """Measure a track and draw its page."""
    methods = _methods(work.methods, work.size.level, work.folder)
    records = run_track(track, methods, work.frames, work.folder, work.cache, work.size)
    key = {name: record.key["method"] for name, record in records.items()}
    key |= {
        "track": repr(track),
        **({"carrier": track.carrier} if track.carrier else {}),
        "rows": work.panel_rows,
        "preparation": asdict(work.size.preparation),
        "frames": drawn_of(work.frames),
    }
    place = work.folder / "pages" / f"{track.name}.png"
    said = place.with_suffix(".json")
    if not place.is_file() or not said.is_file() or json.loads(said.read_text()) != key:
        frames = {}
        for number in drawn_of(work.frames):
            estimates = {name: record.drawn()[number] for name, record in records.items()}
            frame = render_frame(track, number, work.size, work.cache)
            frames[frame.name] = (frame, estimates)
        place.parent.mkdir(parents=True, exist_ok=True)
        write_image(place, page(frames, work.panel_rows))
        write_json(said, key)


@lru_cache(maxsize=1)
def _methods(words: tuple[str, ...], level: int, folder: Path) -> list[Method]:
    return make_methods(words, level, folder / "constant.pt")


def _end_with_parent() -> None:
    """Let this process end when the one that started it is killed."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
