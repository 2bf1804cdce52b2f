# SPDX-License-Identifier: Apache-2.0
"""Measuring speed measures what it says; how fast things are is not a matter for tests."""

from __future__ import annotations

import json
import math
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from hydra import initialize_config_module
from omegaconf import DictConfig
from torch import Tensor

from sphericalvision.cameras import ring_rig
from sphericalvision.kernels import kernel_mode
from sphericalvision.recipes.evaluation.places import FrameTruth
from sphericalvision.recipes.evaluation.track_frames import render_frame
from sphericalvision.recipes.evaluation.tracks import TRACKS
from sphericalvision.recipes.speed import measuring
from sphericalvision.recipes.speed.cameras import cameras
from sphericalvision.recipes.speed.command import measure_speed
from sphericalvision.recipes.speed.frames import SCALE, _error, preset_predictor
from sphericalvision.recipes.speed.measuring import (
    OURS,
    Comparison,
    Measurement,
    comparison_table,
    measure,
    ways,
)
from sphericalvision.sweep import inverse_depth_from_index
from tests.processes import python
from tests.recipes.test_depth_benchmark import TINY
from tests.recipes.tiny import composed

CPU = torch.device("cpu")


def config(*overrides: str) -> DictConfig:
    tiny = "settings=[[3,4]]", "feature_channels=2", "image_size=[32,32]", "seconds=1e-9", "num_frames=1"
    small = "convolution_settings=[[3,2]]", "num_points=50", "image_sides=[32]"
    return composed("speed", *tiny, *small, *overrides)


def measured(folder: Path, *overrides: str) -> list[Measurement]:
    """What one round of the command measures."""
    keys = config(*overrides)
    with initialize_config_module("sphericalvision.conf", version_base="1.3"):
        return measure_speed(keys, folder, min_rounds=1)


STAGES = {
    "projection of four fisheye images",
    "sweep tables of a new rig",
    "features of four cameras",
    "cost volume",
    "regulariser",
    "whole inference",
    "one training step, without the optimiser",
    "memory that inference adds",
    "memory that training adds",
}


@pytest.mark.slow
def test_figures_of_a_gpu_are_made_on_any_device(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything runs that will on a GPU, in smaller batches, but for the capture of CUDA graphs."""
    monkeypatch.setattr("sphericalvision.recipes.speed.networks.BATCHES", (1, 2))  # 16 take 15 GB
    rows = measured(tmp_path, "groups=[gpu]", "image_sides=[64]", "device=cpu")
    parity = {row.name: row.median for row in rows if row.unit == "hypotheses"}
    assert parity["default"] == parity["level 7"] == 0  # one device with itself
    assert 0 < parity["default, float16"] < parity["default, bfloat16"] < 0.02
    passes = {row.title: row for row in rows if row.unit == "s"}
    assert {f"IcoSweepNet 3/4: a forward pass of {batch}" for batch in (1, 2)} < set(passes)
    assert {f"default: a training step of {batch}" for batch in (1, 2)} < set(passes)
    assert all(row.median > 0 for row in passes.values())


def test_tables_hold_every_stage(tmp_path: Path) -> None:
    rows = measured(tmp_path)
    stored = json.loads((tmp_path / "speed.json").read_text())
    assert [row["name"] for row in stored["rows"]] == [row.name for row in rows]
    assert stored["machine"]["torch"] == torch.__version__
    assert {row.title.partition(": ")[2] for row in rows} == STAGES
    text = (tmp_path / "speed.md").read_text()
    assert {text.count(f"{row.title}\n") for row in rows} == {1}
    assert {row.spread for row in rows} == {0}  # after a billionth of a second, and one round
    inference = {row.name: row for row in rows if "whole inference" in row.title}
    assert list(inference) == ["plain", OURS]
    assert inference["plain"].ratio == 1


def test_ways_are_modes_of_the_kernels_and_a_precision() -> None:
    """Which give the same numbers, as tests of the kernels say."""
    modes = {name: run() for name, run in ways(kernel_mode, ["layers"], CPU).items()}
    assert modes == {"plain": "reference", OURS: kernel_mode(), f"{OURS}, layers": "plain"}
    product = ways(lambda: torch.ones(2, 2) @ torch.ones(2, 2), ["bf16"], CPU)
    assert product[f"{OURS}, bf16"]().dtype == torch.bfloat16


def test_what_functions_report_is_asked_once_and_not_timed() -> None:
    once = iter([2.0])
    runs = {"plain": lambda: 4.0, "ours": lambda: next(once), "nothing": lambda: 0.0}
    plain, ours, nothing = measure(Comparison("memory", runs, unit="MB"))
    assert (plain.median, plain.unit, plain.spread, plain.cpu) == (4.0, "MB", 0.0, 0.0)
    assert (ours.median, ours.ratio, nothing.ratio) == (2.0, 2.0, math.inf)
    row, *_ = comparison_table([ours]).texts()
    assert row == ["ours", "2 MB", "", "2.00", "", ""]


def test_ratio_is_the_first_time_over_ones_own(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]

    def run(seconds: float) -> None:
        clock[0] += seconds

    monkeypatch.setattr(measuring, "timer", lambda: clock[0])
    slow, fast = measure(Comparison("sleep", {"slow": partial(run, 0.02), "fast": partial(run, 0.004)}))
    assert (slow.median, slow.ratio, slow.unit) == (pytest.approx(0.02), 1, "s")
    assert (fast.median, fast.ratio) == (pytest.approx(0.004), pytest.approx(5))
    assert slow.cpu < 0.01  # the clock moves without work


def test_memory_is_the_most_that_is_held_at_once() -> None:
    """In a process of its own: the system counts what all threads take and give back."""
    code = """
import torch
from sphericalvision.recipes.speed.measuring import added_memory
def run():
    for _ in range(2): torch.zeros(10**8)
print(added_memory(run, torch.device("cpu")))"""
    assert float(python("-c", code)) == pytest.approx(400, abs=5)


def test_presets_are_those_of_predict(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        torch.cuda, "is_available", lambda: True
    )  # on the device that is asked for, nevertheless
    with initialize_config_module("sphericalvision.conf", version_base="1.3"):
        live, default = (
            preset_predictor(name, ring_rig(4, image_size=(64, 64)), CPU) for name in ("live", "default")
        )
    assert [predictor.preparation.photometric for predictor in (live, default)] == [False, True]
    assert live.network.level == 5 < default.network.level


@pytest.mark.parametrize(
    ("group", "names"),
    [
        ("convolutions", {"planar", "hex along charts", "crown, both directions"}),
        ("data", {"room", "bare"}),
        ("fps", {"live, 1 threads", "live, 2 threads"}),
        (
            "variants",
            {"icosweepnet_rt, plain", "semi-global sweep, bf16", "icosweepnet_rt, recompute"},
        ),
    ],
)
def test_every_group_measures_its_rows(tmp_path: Path, group: str, names: set[str]) -> None:
    rows = measured(
        tmp_path, f"groups=[{group}]", "presets=[live]", "variants=[icosweepnet_rt]", "options=[bf16]"
    )
    assert all(row.median > 0 for row in rows)
    assert {row.name for row in rows} >= names


def test_errors_of_presets_are_of_places_that_two_cameras_see() -> None:
    frame = render_frame(TRACKS["ugv_masked"], 1, TINY)
    truth = FrameTruth(frame)

    def at(directions: Tensor) -> tuple[Tensor]:
        ids = (directions @ truth.fine.vertices.T).argmax(1)
        return (
            inverse_depth_from_index(truth.index[ids] + 0.16, *SCALE).where(truth.regions["all"][ids], 0.0),
        )

    predictor: Any = SimpleNamespace(
        with_changes=lambda _: lambda _: SimpleNamespace(at=at, index=torch.zeros(1))
    )
    assert _error(predictor, [frame]) == pytest.approx(16 / SCALE.num_hypotheses, rel=1e-3)


@pytest.mark.slow
def test_presets_have_errors_times_and_memory(tmp_path: Path) -> None:
    rows = measured(tmp_path, "groups=[presets]", "presets=[live,fast]")
    assert {row.unit for row in rows} == {"s", "MB", "% of N"}
    assert all(0 < row.median < 100 for row in rows if row.unit == "% of N")


def test_what_to_measure_is_found_by_title(tmp_path: Path) -> None:
    rows = measured(tmp_path, "only='tables|cost'")
    assert {row.title.partition(": ")[2] for row in rows} == {"sweep tables of a new rig", "cost volume"}


def test_others_measure_the_same() -> None:
    """Other libraries the same lens, where they answer in pixels, and away from 90°; torch the same image."""
    runs_of = {comparison.title: comparison.runs for comparison in cameras(config(), CPU)}
    images = [runs for title, runs in runs_of.items() if title.startswith("image of")]
    for runs in images:
        plain, image = (runs[name]() for name in ("bare grid_sample", "Remap"))
        assert ((plain - image).abs() < 1e-3).float().mean() > 0.4  # the fisheye sees half of the panorama
    lenses, compared = runs_of["project 50 points, float64"], len(images)
    for name, run in lenses.items():
        model, _, library = name.rpartition(", ")
        if library in ("OpenCV", "kornia", "ds-msp"):
            pixels, valid = lenses[model]()
            answer = run()
            other = torch.as_tensor(answer if isinstance(answer, torch.Tensor) else answer[0]).squeeze()
            central = valid & ((pixels - 400).norm(dim=-1) < 300)
            torch.testing.assert_close(other[central], pixels[central], atol=1e-4, rtol=0)
            compared += 1
    assert compared >= 6
