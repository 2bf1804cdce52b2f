# SPDX-License-Identifier: Apache-2.0
"""Numbers of comparisons: which error is in which column of which view, what counts as which place, and tracks."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import astuple
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from sphericalvision.core import ArgumentError
from sphericalvision.data import SampleView
from sphericalvision.icosphere import Icosphere
from sphericalvision.recipes.app.rigs import make_corner_rig
from sphericalvision.recipes.datamodules.data_module import SampleDataModule
from sphericalvision.recipes.evaluation.benchmark import benchmark_tables
from sphericalvision.recipes.evaluation.loop import errors_of_frame
from sphericalvision.recipes.evaluation.methods import (
    Answer,
    Method,
    Scale,
    baselines,
    training_depths,
)
from sphericalvision.recipes.evaluation.places import FrameTruth, PlaceErrors
from sphericalvision.recipes.evaluation.records import Record, write_json
from sphericalvision.recipes.evaluation.results import Results
from sphericalvision.recipes.evaluation.tables import Cell, Table
from sphericalvision.recipes.evaluation.track_frames import render_frame
from sphericalvision.recipes.evaluation.tracks import TRACKS
from sphericalvision.recipes.study.report import study_tables
from sphericalvision.recipes.study.tilted_views import View
from sphericalvision.recipes.study.training import Training
from sphericalvision.sweep import DepthEstimate
from tests.recipes.test_depth_benchmark import TINY, Oracle
from tests.values import weighted_sum


class Anything(Mapping[str, Any]):
    """Errors of any path: a number that follows from it."""

    def __init__(self, path: str) -> None:
        self.path = path

    def __getitem__(self, key: str) -> Anything:
        return Anything(f"{self.path} {key}")

    def __float__(self) -> float:
        return zlib.crc32(self.path.encode()) % 1000 / 100

    def __len__(self) -> int:
        return 1

    def __iter__(self) -> Iterator[str]:
        return iter("")


def comparison(*sets: str) -> Results:
    """Two seeds of a model, and another one, on three frames of each set."""
    methods = [
        Method("net/seed0", Oracle(), label="net", seed=0),
        Method("net/seed1", Oracle(), label="net", seed=1),
    ]
    methods.append(Method("sweep", Oracle()))
    records: dict[str, dict[str, Record]] = {name: {} for name in sets}
    for name in sets:
        for method in methods:
            records[name][method.name] = record = Record()
            record.frames = {str(frame): Anything(f"{name} {method.name} {frame}") for frame in range(3)}  # type: ignore[misc]
    return Results(methods, records)


def sum_of_cells(table: Table) -> float:
    """Of means, deviations, bounds and digits, column by column in the order of their names."""
    numbers = []
    for column in sorted(range(len(table.columns)), key=lambda k: table.columns[k]):
        for cell in (row[column] for row in table.rows):
            if isinstance(cell, Cell):
                numbers += [cell.mean, cell.spread or 0.0, *(cell.interval or ()), cell.digits, cell.best]
            elif isinstance(cell, float):
                numbers.append(cell)
    return weighted_sum(torch.tensor(numbers, dtype=torch.float64))


def test_tables_of_a_study_hold_the_errors_that_their_columns_say() -> None:
    views = [View("fisheye", 0.0), View("fisheye", 45.0), View("equirect", 0.0)]
    results = comparison(*(view.name for view in views))
    config = OmegaConf.create({"num_hypotheses": 16, "model": {"level": 6}})
    tables = study_tables(results, config, views)
    expected = {"table": -1.2012, "change": -0.776, "where": 3.7668, "inputs": -3.5369, "details": 1.0913}
    assert {name: sum_of_cells(table) for name, table in tables.items()} == pytest.approx(expected, abs=1e-3)
    assert [row[0] for row in tables["inputs"].rows] == ["fisheye", "fisheye", "equirect", "equirect"]
    assert "inputs" not in study_tables(results, config, views[:2])


def test_tables_of_the_benchmark_hold_the_errors_that_their_columns_say() -> None:
    tracks = [TRACKS[name] for name in ("room", "tilt_0", "tilt_30")]
    tables = benchmark_tables(comparison(*(track.name for track in tracks)), tracks, 5)
    sums = [sum_of_cells(table) for table in tables.values()]
    expected = [
        -36.6969,
        -33.8647,
        -28.4741,
        -22.0877,
        -31.7285,
        -31.6828,
        -34.5895,
        5.3791,
        -1.9882,
        1.3933,
        -3.3597,
    ]
    assert sums == pytest.approx(expected, abs=1e-3)
    assert "Against tilt" not in benchmark_tables(comparison("room"), tracks[:1], 5)


def numbers_of(errors: Mapping[str, Any]) -> list[float]:
    """All numbers of nested errors; -1 where there is none."""
    values = (numbers_of(value) if isinstance(value, Mapping) else [value] for value in errors.values())
    return [-1.0 if number is None else number for numbers in values for number in numbers]


OFF_EVERYWHERE = {
    "room": 273.5414,
    "bare": 138.3122,
    "outdoors": 199.5985,
    "ugv_masked": 314.4215,
    "tilt_45": 315.7636,
    "random": 108.4976,
}


@pytest.mark.parametrize(("track", "expected"), OFF_EVERYWHERE.items())
def test_errors_by_place_of_an_estimate_that_is_off_everywhere(track: str, expected: float) -> None:
    """By as much as the direction says, and as sure: levels, panorama, metres, regions, and the surest points."""
    frame = render_frame(TRACKS[track], 1, TINY)
    net, truth = Oracle(), FrameTruth(frame)
    x, y, z = Icosphere(3).vertices.unbind(-1)
    index = (truth.index + 0.5 + x - 0.7 * y * z).clamp(min=0)[None]
    answer = Answer(
        net, DepthEstimate(index, (z - x).sigmoid()[None], torch.ones_like(index, dtype=torch.bool)), 0.3
    )
    errors = errors_of_frame(PlaceErrors(3).errors(answer, truth), 0)
    assert weighted_sum(torch.tensor(numbers_of(errors))) == pytest.approx(expected, abs=0.5)


def test_a_track_is_what_it_was() -> None:
    """Or published numbers and records are of other frames than they say."""
    numbers = [
        torch.tensor(
            [t.num_cameras, t.radius, t.tilt_deg, t.masked, *t.shared_tilts_deg, *astuple(t.disturbance)[:-1]]
        )
        for t in TRACKS.values()
    ]
    assert len(TRACKS) == 42
    assert weighted_sum(*numbers) == pytest.approx(-29.06656, abs=1e-3)


def test_constant_maps_are_medians_of_vertices_and_of_all() -> None:
    """In two batches, of what is valid."""
    depth = torch.arange(1.0, 6.0)[:, None] * torch.linspace(1, 2, 42)
    valid = torch.ones_like(depth, dtype=torch.bool)
    valid[3:, :9] = False
    halves = [
        {"inverse_depth": 1 / d, "valid": v} for d, v in zip(depth.split(2), valid.split(2), strict=True)
    ]
    methods = baselines(Scale(12, 0.9), 3, halves)
    assert [method.name for method in methods[2:]] == ["winner-takes-all", "semi-global-sweep"]
    index = [method.net.predict(torch.zeros(1, 2, 3, 642), None).index[0] for method in methods[:2]]
    median = torch.where(valid[3], depth[2], depth[1])
    torch.testing.assert_close(index[0], 11 * 0.9 / median)
    torch.testing.assert_close(index[1], (11 * 0.9 / depth[valid].median()).expand(42))
    with pytest.raises(ArgumentError, match=r"^data: .* valid depth"):
        baselines(Scale(12, 0.9), 3, [{"inverse_depth": 1 / depth, "valid": ~valid & valid}])


@pytest.mark.parametrize(
    ("most", "numbers"), [(None, range(10)), (4, [0, 3, 6, 9]), (10, range(10)), (6, [0, 2, 4, 6, 8])]
)
def test_depths_of_a_training_are_of_frames_at_even_distances(most: int | None, numbers: list[int]) -> None:
    class Frames(SampleDataModule):
        view = SampleView(6)

        def plain_train_dataset(self) -> Any:
            assert self.view == SampleView(depth_level=3)
            return [{"inverse_depth": torch.tensor(float(k))} for k in range(10)]

    data = Frames(batch_size=3)
    found = torch.cat([batch["inverse_depth"] for batch in training_depths(data, 5, most)])
    assert found.tolist() == list(numbers)
    assert data.view == SampleView(6)


def test_cameras_at_the_corners_of_a_vehicle() -> None:
    rig = make_corner_rig(width=0.4, length=1.0, image_size=(20, 30), field_of_view_deg=170, tilt_deg=30)
    corners = {"front_right": (1, 1), "back_right": (1, -1), "back_left": (-1, -1), "front_left": (-1, 1)}
    assert list(rig.names) == list(corners)
    for (x, z), position, axis in zip(corners.values(), rig.positions, rig.axes, strict=True):
        torch.testing.assert_close(position, torch.tensor([0.2 * x, 0.0, 0.5 * z]))
        aside = math.cos(math.pi / 6) * math.sqrt(0.5)
        torch.testing.assert_close(axis, torch.tensor([aside * x, 0.5, aside * z]))
    assert rig.max_angles.rad2deg().tolist() == pytest.approx([85] * 4)
    assert rig.cameras["back_left"].image_size == (20, 30)


def test_a_training_is_done_that_has_its_errors_and_its_weights_and_the_same_settings(tmp_path: Path) -> None:
    config = OmegaConf.create({"seed": 1, "output": "a"})
    training = Training("net", 1, tmp_path, (), config)
    done = []
    for write in (
        lambda: write_json(training.weights, {}),
        lambda: training.weights.rename(tmp_path / "away"),
        lambda: write_json(tmp_path / "validation.json", {}),
        lambda: (tmp_path / "away").rename(training.weights),
        lambda: (tmp_path / "config.yaml").write_text("seed: 1\noutput: b\n"),
        lambda: (tmp_path / "config.yaml").write_text("seed: 2\n"),
    ):
        write()
        done.append(training.is_done)
    assert done == [False, False, False, True, True, False]
    assert training.weights == tmp_path / "checkpoints/best.safetensors"
