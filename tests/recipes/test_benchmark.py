# SPDX-License-Identifier: Apache-2.0
"""The benchmark measures what it says; how fast things are is not a matter for tests."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_module

from sphericalvision.core import ArgumentError
from sphericalvision.recipes.benchmark import alone as bench_alone
from sphericalvision.recipes.benchmark import cameras as bench_cameras
from sphericalvision.recipes.benchmark import network as bench_network
from sphericalvision.recipes.benchmark.command import benchmark
from sphericalvision.recipes.benchmark.measuring import (
    BF16,
    Comparison,
    Measurement,
    measure,
    peaks_of,
    share_of_peak,
)
from sphericalvision.recipes.benchmark.network import comparisons
from sphericalvision.recipes.benchmark.processes import seconds_per_sample
from sphericalvision.scenes.registry import scene_kinds

TINY = [
    "groups=[machine,network]",
    "settings=[[3,4]]",
    "feature_channels=2",
    "image_size=[32,32]",
    "seconds=0.0",
    "peak_size=128",
    "num_frames=2",
]


@pytest.fixture(autouse=True)
def one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stages that get a process of their own stay in this one: a process takes seconds to start."""

    def alone(stage: str, way: str, level: int, num_hypotheses: int, device: str, **options: int) -> float:
        return bench_alone._run(stage, way, level, num_hypotheses, device, **options)

    monkeypatch.setattr(bench_network, "alone", alone)


def config(*overrides: str):  # type: ignore[no-untyped-def]
    with initialize_config_module("sphericalvision.conf", version_base="1.3"):
        return compose("benchmark", [*TINY, *overrides])


def test_tables_hold_every_comparison(tmp_path: Path) -> None:
    rows = benchmark(config(), tmp_path)
    stored = json.loads((tmp_path / "benchmark.json").read_text())
    assert [row["name"] for row in stored["rows"]] == [row.name for row in rows]
    assert stored["machine"]["torch"] == torch.__version__
    text = (tmp_path / "benchmark.md").read_text()
    for row in rows:
        assert row.comparison.title in text
        assert row.rounds >= 3 or row.unit == "MB"
    inference = {row.name: row for row in rows if "whole inference" in row.comparison.title}
    assert inference["plain"].ratio == 1
    assert inference["plain"].comparison.gflop is not None


STAGES = {
    "set-up from cold",
    "sweep tables of a new rig",
    "projection of four fisheye images",
    "features of four cameras",
    "cost volume",
    "regulariser",
    "regression",
    "whole inference",
    "one training step, without the optimiser",
    "memory that inference adds",
    "memory that training adds",
}


def test_every_stage_has_its_row_its_needs_and_its_share_of_the_peak(tmp_path: Path) -> None:
    rows = benchmark(config("options=[bf16]"), tmp_path)
    stages = {
        row.comparison.title.split(": ")[1]: row for row in rows if row.comparison.title.startswith("level")
    }
    assert set(stages) == STAGES
    for row in rows:
        if row.comparison.peak is None and row.unit == "s" and "set-up" not in row.comparison.title:
            assert row.comparison.gbyte is not None
            assert row.share is not None
            assert row.share > 0
            assert row.first is not None
    assert {row.name for row in rows if "whole inference" in row.comparison.title} == {
        "plain",
        "sphericalvision",
        f"sphericalvision{BF16}",
    }


def test_layers_have_their_rows(tmp_path: Path) -> None:
    rows = benchmark(config("options=[layers]", "training=false", "only=inference|regulariser"), tmp_path)
    assert {row.name for row in rows} == {"plain", "sphericalvision", "sphericalvision, layers"}
    (comparison,) = (
        c for c in comparisons(config("options=[layers]"), torch.device("cpu")) if "whole" in c.title
    )
    torch.testing.assert_close(*(comparison.runs[name]() for name in ("plain", "sphericalvision, layers")))


def test_share_of_the_peak_is_the_least_time_over_the_time_taken() -> None:
    def row(name: str, seconds: float, peak: str, amount: float) -> Measurement:
        return Measurement(Comparison("peak", {}, name, amount, gbyte=amount, peak=peak), name, seconds)

    peaks = peaks_of(
        [
            row("matmul", 2.0, "FLOP", 200.0),  # 100 GFLOP/s
            row("conv2d", 1.0, "FLOP", 150.0),  # 150, the better
            row("conv2d" + BF16, 1.0, "FLOP", 300.0),
            row("copy", 0.5, "byte", 5.0),  # 10 GB/s
        ]
    )

    def share(gflop: float | None, gbyte: float | None = None, name: str = "stage") -> float | None:
        return share_of_peak(peaks, Comparison("work", {}, name, gflop, gbyte=gbyte), name, 1.0)

    assert share(75.0, 1.0) == pytest.approx(0.5)
    assert share(15.0, 4.0) == pytest.approx(0.4)
    assert share(75.0, name="stage" + BF16) == pytest.approx(0.25)
    assert share(None) is None
    assert share_of_peak({}, Comparison("work", {}, "stage", 75.0), "stage", 1.0) is None


def test_what_functions_report_is_not_timed() -> None:
    given = iter([3.0, 1.0, 2.0])
    runs = {"plain": lambda: 4.0, "ours": lambda: next(given)}
    plain, ours = measure(Comparison("memory", runs, "plain", unit="MB", rounds=3))
    assert (plain.median, plain.unit, plain.spread, plain.first) == (4.0, "MB", 0.0, None)
    assert (ours.median, ours.ratio, ours.rounds) == (2.0, 2.0, 3)


@pytest.mark.slow
def test_a_process_of_its_own_reports_memory_and_says_what_went_wrong() -> None:
    assert bench_alone.alone("inference", "plain", level=3, num_hypotheses=4, feature_channels=2) > 0
    with pytest.raises(ArgumentError, match="level"):
        bench_alone.alone("inference", "plain", level=-1, num_hypotheses=4)


def test_training_that_waits_for_data(tmp_path: Path) -> None:
    rows = benchmark(config("groups=[data]"), tmp_path)
    assert {row.name for row in rows if "rendering" in row.comparison.title} == set(scene_kinds())
    waiting = [row.median for row in rows if row.unit == "%"]
    assert len(waiting) == 2
    assert all(0 <= share <= 100 for share in waiting)


@pytest.mark.parametrize("group", ["sweep", "training"])
def test_processor_time_by_both_ways(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, group: str) -> None:
    monkeypatch.setattr(f"sphericalvision.recipes.benchmark.{group}.LEVEL", 4)
    monkeypatch.setattr(f"sphericalvision.recipes.benchmark.{group}.HYPOTHESES", 4)
    rows = benchmark(config(f"groups=[{group}]"), tmp_path)
    assert {row.name for row in rows} == {"plain", "sphericalvision"}
    assert all(row.median > 0 and row.unit == "s" for row in rows)


def test_prediction_is_timed_from_video_to_video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sphericalvision.recipes.benchmark.predict.SIZE", (32, 32))
    monkeypatch.setattr("sphericalvision.recipes.benchmark.predict.SETTINGS", {"tiny": (5, 16)})
    rows = benchmark(config("groups=[predict]", "num_frames=2"), tmp_path)
    assert [row.name for row in rows] == [
        "network alone, all threads for a frame",
        "network alone",
        "sphericalvision",
    ]
    assert all(row.median > 0 and row.unit == "s" for row in rows)


@pytest.mark.slow
def test_two_processes_share_the_samples() -> None:
    """What they take together is the time of one sample."""
    assert 0 < seconds_per_sample(processes=2, threads=1, seconds=0.1) < 60


def test_an_unknown_option_is_refused() -> None:
    with pytest.raises(ArgumentError, match=r"options.*compiled"):
        next(comparisons(config("options=[fp8]"), torch.device("cpu")))


def test_ratio_is_the_reference_time_over_ones_own() -> None:
    runs = {"slow": lambda: time.sleep(0.02), "fast": lambda: time.sleep(0.004)}
    slow, fast = measure(Comparison("sleep", runs, "slow", gflop=0.02), seconds=0.0)
    assert slow.ratio == 1
    assert fast.ratio == pytest.approx(slow.median / fast.median, rel=0.5)
    assert fast.ratio > 1
    assert slow.facts["gflop"] == 0.02


def test_stages_that_are_compared_give_the_same_numbers() -> None:
    names = [c.title.split(": ")[1] for c in comparisons(config(), torch.device("cpu"))]
    assert {"features of four cameras", "cost volume", "regulariser", "whole inference"} <= set(names)
    for comparison in comparisons(config(), torch.device("cpu")):
        if "cost volume" in comparison.title:
            plain, ours = (run().values for run in comparison.runs.values())
            torch.testing.assert_close(ours, plain)
        if "regulariser" in comparison.title or "inference" in comparison.title:
            torch.testing.assert_close(*(run() for run in comparison.runs.values()), rtol=0, atol=1e-4)


def test_an_unknown_group_is_refused_before_anything_runs(tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match=r"groups.*network"):
        benchmark(config("groups=[network,speed]"), tmp_path)
    assert not list(tmp_path.iterdir())


def test_what_to_measure_is_found_by_title(tmp_path: Path) -> None:
    titles = {row.comparison.title for row in benchmark(config("only='copy|regression'"), tmp_path)}
    assert sorted(title.split(":")[0] for title in titles) == ["level 3 to 1, N = 4", "peak"]
    with pytest.raises(ArgumentError, match="only: expected a part of a title"):
        benchmark(config("only=regresion"), tmp_path)
    with pytest.raises(ArgumentError, match="only: expected a regular expression"):
        benchmark(config("only='('"), tmp_path)


def test_other_libraries_measure_the_same_lens() -> None:
    """Where they answer in pixels, and away from 90°."""
    compared = 0
    for comparison in bench_cameras.comparisons(config("num_points=50"), torch.device("cpu")):
        if not comparison.title.startswith("project") or "float64" not in comparison.title:
            continue
        pixels, valid = comparison.runs["sphericalvision"]()
        for name in {"OpenCV", "kornia", "ds-msp"} & set(comparison.runs):
            answer = comparison.runs[name]()
            found = torch.as_tensor(answer if isinstance(answer, torch.Tensor) else answer[0]).squeeze()
            near = valid & ((pixels - 400).norm(dim=-1) < 300)
            torch.testing.assert_close(found[near], pixels[near], atol=1e-4, rtol=0)
            compared += 1
    assert compared >= 3
