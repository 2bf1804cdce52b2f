# SPDX-License-Identifier: Apache-2.0
"""``sphericalvision-benchmark``: methods by tracks, in processes."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from annotated_types import MinLen
from joblib import Parallel, delayed
from pydantic.dataclasses import dataclass

from sphericalvision.capture.predictor import threads_kept
from sphericalvision.core import FileFormatError
from sphericalvision.io.images import as_bytes, write_image
from sphericalvision.recipes.app.checks import flat
from sphericalvision.recipes.app.cli import console, print_config
from sphericalvision.recipes.app.kinds import STRICT, Count, Number, Positive, Text
from sphericalvision.recipes.evaluation.loop import Limit, evaluate, limit_text
from sphericalvision.recipes.evaluation.methods import SCALE, Method, check_names, make_method
from sphericalvision.recipes.evaluation.pictures import DrawnFrame, camera_picture, frames_sheet
from sphericalvision.recipes.evaluation.places import KEPT, REGIONS, FrameTruth, PlaceErrors
from sphericalvision.recipes.evaluation.records import Record, read_json, write_json
from sphericalvision.recipes.evaluation.results import Results
from sphericalvision.recipes.evaluation.tables import Cell, Row, Table, save_report, summarize
from sphericalvision.recipes.evaluation.track_frames import Size, TrackFrames
from sphericalvision.recipes.evaluation.tracks import Track, chosen_tracks
from sphericalvision.viz.panorama import icosphere_to_panorama


@dataclass(frozen=True, kw_only=True, config=STRICT)
class BenchmarkConfig:
    """Keys of ``conf/benchmark.yaml``."""

    output: Text
    size: Size
    methods: Annotated[list[str], MinLen(1)]
    tracks: list[str]
    frames: Count
    first_frame: Number
    meshes: list[str]
    max_depth_m: Positive | Literal["auto"]
    cache_dir: Text | None
    panel_height: Count
    workers: Number


BY_TRACK: dict[str, tuple[str, str, int]] = {
    "MAE at {coarse}": ("MAE at {coarse}", "coarse all MAE", 2),
    "MAE at {fine}": ("MAE at {fine}", "fine all MAE", 2),
    "MAE on a panorama": ("MAE on a panorama, by solid angle", "panorama MAE", 2),
    "Points off by more than 1 %": ("Points off by more than 1 % at {coarse}", "coarse all >1", 2),
    "RMS at {coarse}": ("RMS at {coarse}", "coarse all RMS", 2),
    "Relative error": ("Mean relative error of the depth, AbsRel, {limit}, at {coarse}", "metres AbsRel", 3),
    "Within a factor of 1.25": (
        "Share of depths within a factor 1.25, d<1.25, {limit}, at {coarse}",
        "metres d<1.25",
        3,
    ),
}
"""Tables of tracks by methods: heading -> title, which of the errors, and its digits."""


def benchmark(config: BenchmarkConfig, folder: Path) -> Results:
    """Measure what is missing, write tables and pictures; returns the results."""
    print_config(config, folder)
    size = config.size
    numbers = range(config.first_frame, config.first_frame + config.frames)
    cache = None if config.cache_dir is None else Path(config.cache_dir).absolute()
    words, tracks = tuple(config.methods), chosen_tracks(config.tracks, config.meshes)
    methods = _methods(words, size.level)
    sets = [TrackFrames(track, numbers, size, cache) for track in tracks]
    console.print(
        f"{len(tracks)} tracks, {config.frames} scenes each, {len(methods)} methods", highlight=False
    )
    processes = Parallel(n_jobs=max(1, config.workers), return_as="generator")
    measured = processes(
        delayed(_measure)(frames, words, folder, config.panel_height, config.max_depth_m) for frames in sets
    )
    records: dict[str, dict[str, Record]] = {}
    for frames, by_method in zip(sets, measured, strict=True):
        records[frames.name] = by_method
        means = {name: record.means["coarse"]["all"]["MAE"] for name, record in by_method.items()}
        errors = (f"{name} {'–' if mean is None else f'{mean:.2f}'}" for name, mean in means.items())
        console.print(f"{frames.name}: MAE {', '.join(errors)}", highlight=False)
    results = Results(methods, records)
    pictures = {track.name: f"pages/{track.name}.png" for track in tracks}
    content = {"config": flat(config), "results": results.plain()}
    tables = benchmark_tables(results, tracks, size.level, config.max_depth_m)
    save_report(folder, "benchmark", "Benchmark of depth methods", tables, pictures, content)
    return results


def benchmark_tables(
    results: Results, tracks: Sequence[Track], level: int, max_depth: Limit = "auto"
) -> dict[str, Table]:
    """The tables by their headings; a table of tilts only where there are such tracks."""
    levels = {"coarse": f"level {level - 2}", "fine": f"level {level}", "limit": limit_text(max_depth)}
    tables = {
        heading.format(**levels): results.by_method(title.format(**levels), "track", path, digits)
        for heading, (title, path, digits) in BY_TRACK.items()
    }
    names = [track.name for track in tracks]
    rows: list[Row] = []
    for region in REGIONS[:-1]:
        errors = [results.cell(label, f"fine {region} MAE", 2, *names) for label in results.labels]
        rows.append([region, results.cell(results.labels[0], f"points {region}", 1, *names), *errors])
    title = (
        f"MAE at {levels['fine']} by kind of place: mean over the frames of all tracks that have such places."
    )
    tables["By kind of place"] = Table(title, ("place", "% of points", *results.labels), rows)
    tilts = {f"{track.tilt_deg:g}°": track.name for track in tracks if track.shared_tilts_deg}
    if len(tilts) > 1:
        title = f"MAE at {levels['coarse']} of the same points, those that two cameras see at every tilt, and ratios."
        tables["Against tilt"] = results.against(title, "coarse shared MAE", tilts)
    rows = []
    for label in results.labels:
        total, *surest = (results.means(label, f"kept {fraction:g}", *names)[0] for fraction in KEPT)
        rows.append([label, summarize([total]), *(summarize([error / total]) for error in surest)])
    columns = ("method", "MAE of all", *(f"surest {100 * fraction:g} %" for fraction in KEPT[1:]))
    title = (
        f"MAE at {levels['coarse']} of the points of which a method is surest, as a ratio to that of all; "
        "mean over tracks."
    )
    tables["Of the surest points"] = Table(title, columns, rows)
    tables["Cost of a frame"] = _cost(results)
    return tables


def _cost(results: Results) -> Table:
    rows: list[Row] = []
    for method in results.methods:
        costs = (records[method.name].cost for records in results.records.values())
        cost = next(filter(None, costs), {"parameters": None, "gflop": None})
        parameters, operations = cost["parameters"], cost["gflop"]
        seconds = results.errors(method, "seconds", *results.records)
        rows.append(
            [
                method.label,
                None if parameters is None else f"{parameters:,}",
                None if operations is None else Cell(operations, digits=1),
                sorted(seconds)[len(seconds) // 2] if seconds else None,
            ]
        )
    title = (
        "What a frame takes: operations of matrices and convolutions in the reference kernels, and CPU seconds on "
        "one thread (median)."
    )
    return Table(title, ("method", "parameters", "GFLOP", "CPU s"), rows)


def run_track(
    frames: TrackFrames, methods: Sequence[Method], folder: Path | None, max_depth: Limit = "auto"
) -> dict[str, Record]:
    """Score methods on frames of a track, those that are not in ``folder`` yet; the records by method."""
    with threads_kept():
        torch.set_num_threads(1)  # for times that mean something
        measure = PlaceErrors(frames.size.level, max_depth)
        return evaluate(methods, frames, measure, folder, count_cost=True)


def _measure(
    frames: TrackFrames, words: tuple[str, ...], folder: Path, rows: int, max_depth: Limit
) -> dict[str, Record]:
    """Measure a track and draw its page; returns the records of its frames by method."""
    records = run_track(frames, _methods(words, frames.size.level), folder, max_depth)
    page = folder / "pages" / f"{frames.track.name}.png"
    key = {name: record.key for name, record in records.items()} | {"rows": rows, "frames": frames.drawn}
    stored: Any = None
    with suppress(OSError, FileFormatError):
        stored = read_json(page.with_suffix(".json"))
    if stored != key or not page.is_file():
        write_image(page, frames_sheet({name: _drawn(frames, name, records, rows) for name in frames.drawn}))
        write_json(page.with_suffix(".json"), key)
    return records


def _drawn(frames: TrackFrames, name: str, records: Mapping[str, Record], rows: int) -> DrawnFrame:
    frame = frames.frame(name)
    truth = FrameTruth(frame)
    camera = frame.rig.names[0]
    return DrawnFrame(
        camera_picture(frame.images[camera] * frame.rig.masks.get(camera, torch.tensor(1.0)), rows),
        as_bytes(icosphere_to_panorama(frame.colors, rows)),
        truth.index.where(truth.valid, torch.nan),
        truth.regions["all"],
        {method: record.drawn[name] for method, record in records.items()},
        SCALE,
    )


@lru_cache(maxsize=1)
def _methods(words: tuple[str, ...], level: int) -> list[Method]:
    """Made once in a process."""
    methods = [make_method(word, level) for word in words]
    check_names(methods)
    return methods
