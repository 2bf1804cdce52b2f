# SPDX-License-Identifier: Apache-2.0
"""``sphericalvision-study preset=benchmark``: tracks by methods, in processes, and what is written at the end."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from joblib import Parallel, delayed
from omegaconf import DictConfig

from sphericalvision.capture.preparation.preparation import Preparation
from sphericalvision.core import FileFormatError
from sphericalvision.io.images import write_image
from sphericalvision.recipes.app.cli import console
from sphericalvision.recipes.evaluation.methods import Method
from sphericalvision.recipes.evaluation.records import Record, read_json, write_json
from sphericalvision.recipes.study.comparison.frames import Size
from sphericalvision.recipes.study.comparison.methods import make_methods
from sphericalvision.recipes.study.comparison.pictures import page
from sphericalvision.recipes.study.comparison.running import TrackFrames, record_of, run_track
from sphericalvision.recipes.study.comparison.tables import Comparison, report
from sphericalvision.recipes.study.comparison.tracks import Track, chosen_tracks

__all__ = ["compare"]


class Setting(NamedTuple):
    """All that a process needs to know, besides the track.

    Attributes:
        methods: their words.
        numbers: of the frames.
        folder: of the results.
        cache: folder of renderings.
        size: how fine frames are.
        panel_rows: of the panoramas that are drawn.
    """

    methods: tuple[str, ...]
    numbers: range
    folder: Path
    cache: Path | None
    size: Size
    panel_rows: int

    def frames(self, track: Track) -> TrackFrames:
        """The frames of a track."""
        return TrackFrames(track, self.numbers, self.size, self.cache)


def compare(config: DictConfig, folder: Path) -> dict[str, dict[str, Record]]:
    """Measure what is missing, write tables and pictures; returns the records by track and method."""
    node = config.benchmark
    preparation = Preparation.from_keys(node)
    size = Size(node.level, node.panorama_rows, node.image_rows, node.samples_per_pixel, preparation)
    setting = Setting(
        tuple(map(str, node.methods)),
        range(node.first_frame, node.first_frame + node.frames),
        folder,
        None if node.cache_dir is None else Path(node.cache_dir).absolute(),
        size,
        config.panel_height,
    )
    tracks = chosen_tracks([str(word) for word in node.tracks], [str(mesh) for mesh in node.meshes])
    methods = _methods(setting.methods, size.level, folder)
    console.print(f"{len(tracks)} tracks, {node.frames} scenes each, {len(methods)} methods", highlight=False)
    processes = Parallel(n_jobs=max(1, node.workers), return_as="generator")
    for summary in processes(delayed(_measure)(track, setting) for track in tracks):
        console.print(summary, highlight=False)
    results = {
        track.name: {
            method.name: record_of(track, method, folder, size).only(setting.frames(track).names)
            for method in methods
        }
        for track in tracks
    }
    report(folder, Comparison(tracks, [method.name for method in methods], results, size.level))
    print(f"Results are in {folder}: benchmark.md, benchmark.json, index.html, pages")
    return results


def _measure(track: Track, setting: Setting) -> str:
    """Measure a track and draw its page; returns a line about it."""
    frames = setting.frames(track)
    records = run_track(frames, _methods(setting.methods, setting.size.level, setting.folder), setting.folder)
    place = setting.folder / "pages" / f"{track.name}.png"
    key = {name: record.key for name, record in records.items()}
    key |= {"rows": setting.panel_rows, "frames": frames.drawn}
    if not (place.is_file() and _key_of(place) == key):
        drawn = {
            name: (frames.frame(name), {method: record.drawn[name] for method, record in records.items()})
            for name in frames.drawn
        }
        place.parent.mkdir(parents=True, exist_ok=True)
        write_image(place, page(drawn, setting.panel_rows))
        write_json(place.with_suffix(".json"), key)
    means = {
        name: record.only(frames.names).means["coarse"]["all"]["MAE"] for name, record in records.items()
    }
    shown = (f"{name} {'–' if mean is None else f'{mean:.2f}'}" for name, mean in means.items())
    return f"{track.name}: MAE {', '.join(shown)}"


def _key_of(page: Path) -> object:
    try:
        return read_json(page.with_suffix(".json"))
    except (OSError, FileFormatError):
        return None


@lru_cache(maxsize=1)
def _methods(words: tuple[str, ...], level: int, folder: Path) -> list[Method]:
    """Made once in a process."""
    return make_methods(words, level, folder)
