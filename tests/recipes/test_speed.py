# SPDX-License-Identifier: Apache-2.0
"""Measuring speed measures what it says; how fast things are is not a matter for tests."""

from __future__ import annotations

import json
import math
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hydra import initialize_config_module
from omegaconf import DictConfig

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.capture import Predictor
from sphericalvision.core import ArgumentError
from sphericalvision.recipes.commands.predict import PredictConfig, predictor_for
from sphericalvision.recipes.speed import cameras as bench_cameras
from sphericalvision.recipes.speed import frames as bench_frames
from sphericalvision.recipes.speed import gpu as bench_gpu
from sphericalvision.recipes.speed import measuring
from sphericalvision.recipes.speed import networks as bench_networks
from sphericalvision.recipes.speed.command import measure_speed
from sphericalvision.recipes.speed.measuring import OURS, Comparison, added_memory, comparison_table, measure
from tests.recipes.tiny import composed

CPU = torch.device("cpu")


def config(*overrides: str) -> DictConfig:
    tiny = "settings=[[3,4]]", "feature_channels=2", "image_size=[32,32]", "seconds=1e-9", "num_frames=2"
    small = "convolution_settings=[[3,2]]", "num_points=50", "image_sides=[32]"
    return composed("speed", *tiny, *small, *overrides)


@pytest.fixture(autouse=True)
def one_round(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measuring, "FEWEST_ROUNDS", 1)


HALF = {"precision": "bfloat16"}
SMALL_SAMPLES = ("data.num_workers=0", "data.image_size=[32,32]", "data.samples_per_pixel=1", "model.level=5")
GPU_TITLES = (
    "the index on the device",
    "default: a forward pass of 1",
    "IcoSweepNet 3/4: a forward pass of 1",
    "Predictor: a call",
    "IcoSweepNet 3/2: a training step of 1",
    "default: a training step of 2",
    "default: a training step of 2 samples that are rendered",
    "default: a forward pass of 2",
    "IcoSweepNet 3/4: a forward pass of 2",
    "memory",
    "rendered",
)
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
    """Everything runs that will on a GPU, in its order, but for the capture of CUDA graphs."""
    monkeypatch.setattr(bench_gpu, "LEVELS", {"default": 5})
    monkeypatch.setattr(bench_gpu, "PREDICTORS", {"level 5": {"level": 5}, "half": {"level": 5, **HALF}})
    monkeypatch.setattr(bench_gpu, "BATCH", 2)
    monkeypatch.setattr(bench_gpu, "TRAINING", [*bench_gpu.TRAINING, *SMALL_SAMPLES])
    words = config("groups=[gpu]", "image_sides=[64]", "device=cpu")
    with initialize_config_module("sphericalvision.conf", version_base="1.3"):
        rows = measure_speed(words, tmp_path)
    titles = list(dict.fromkeys(row.title for row in rows))
    for title, part in zip(titles, GPU_TITLES, strict=True):
        assert part in title
    same, half = (row.median for row in rows[:2])
    assert same == 0  # one device with itself
    assert 0 < half < 0.02
    names = [row.name for row in rows if row.title == "default: a forward pass of 1"]
    assert names == ["eager", "float32", "float32, hexagons by operators of torch", "bfloat16", "float16"]
    assert all(row.median > 0 for row in rows[2:])


def test_tables_hold_every_stage(tmp_path: Path) -> None:
    rows = measure_speed(config(), tmp_path)
    stored = json.loads((tmp_path / "speed.json").read_text())
    assert [row["name"] for row in stored["rows"]] == [row.name for row in rows]
    assert stored["machine"]["torch"] == torch.__version__
    assert {row.title.partition(": ")[2] for row in rows} == STAGES
    text = (tmp_path / "speed.md").read_text()
    assert all(row.title in text for row in rows)
    inference = {row.name: row for row in rows if "whole inference" in row.title}
    assert list(inference) == ["plain", OURS]
    assert inference["plain"].ratio == 1


def test_ways_give_the_same_numbers() -> None:
    compared = 0
    for comparison in bench_networks.network(config("options=[layers,bf16]"), CPU):
        if "cost volume" in comparison.title:
            plain, *others = (run().values for name, run in comparison.runs.items() if "bf16" not in name)
        elif "regulariser" in comparison.title or "whole" in comparison.title:
            plain, *others = (run() for name, run in comparison.runs.items() if "bf16" not in name)
            half = comparison.runs[f"{OURS}, bf16"]()
            torch.testing.assert_close(half.float(), plain, rtol=0.1, atol=0.1)
            assert not torch.equal(half.float(), others[0])
        else:
            continue
        compared += len(others)
        for other in others:
            torch.testing.assert_close(other, plain, rtol=0, atol=1e-4)
    assert compared == 6


def test_what_functions_report_is_asked_once_and_not_timed() -> None:
    once = iter([2.0])
    runs = {"plain": lambda: 4.0, "ours": lambda: next(once), "nothing": lambda: 0.0}
    plain, ours, nothing = measure(Comparison("memory", runs, unit="MB"))
    assert (plain.median, plain.unit, plain.spread, plain.cpu) == (4.0, "MB", 0.0, 0.0)
    assert (ours.median, ours.ratio, nothing.ratio) == (2.0, 2.0, math.inf)
    row, *_ = comparison_table([ours]).texts()
    assert row == ["ours", "2 MB", "", "2.00", "", ""]


def test_ratio_is_the_first_time_over_ones_own() -> None:
    runs = {"slow": lambda: time.sleep(0.02), "fast": lambda: time.sleep(0.004)}
    slow, fast = measure(Comparison("sleep", runs), seconds=0.0)
    assert slow.ratio == 1
    assert fast.ratio == pytest.approx(slow.median / fast.median, rel=0.5)
    assert fast.ratio > 1
    assert slow.cpu < 0.01  # asleep


def test_memory_is_the_most_that_is_held_at_once() -> None:
    def run() -> None:
        for _ in range(2):
            torch.zeros(10_000_000)

    # Threads of other tests may take memory meanwhile, which only adds.
    assert min(added_memory(run, CPU) for _ in range(5)) == pytest.approx(40, abs=8)


def test_presets_are_those_of_predict(monkeypatch: pytest.MonkeyPatch) -> None:
    configs: list[PredictConfig] = []
    monkeypatch.setattr(bench_frames, "predictor_for", lambda rig, config: configs.append(config))
    with initialize_config_module("sphericalvision.conf", version_base="1.3"):
        for name in ("live", "fast", "default", "fine", "finest"):
            bench_frames.preset_predictor(name, ring_rig(4), CPU)
    assert [config.preparation.photometric for config in configs] == [False, True, True, True, True]
    assert [config.level for config in configs] == [5, 5, None, 7, 8]


def small_predictor(rig: CameraRig, config: PredictConfig) -> Predictor:
    return predictor_for(rig, replace(config, checkpoint="icosweepnet-small", level=4, height=16))


@pytest.mark.parametrize("group", ["sweep", "training", "convolutions", "data", "fps", "presets"])
def test_every_group_measures_its_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, group: str) -> None:
    monkeypatch.setattr(bench_networks, "FRAME", (4, 4))
    monkeypatch.setattr(bench_frames, "CONDITIONS", {"clean": ("clean",)})
    monkeypatch.setattr(bench_frames, "predictor_for", small_predictor)
    monkeypatch.setattr(bench_frames, "THREADS", (1,))
    monkeypatch.setattr(bench_frames, "scene_kinds", lambda: ("room", "bare"))
    expected = {
        "sweep": {"plain", OURS},
        "training": {"plain", OURS, f"{OURS}, recompute"},
        "convolutions": {"planar", "hex along charts", "crown, both directions"},
        "data": {"room", "bare"},
        "fps": {"live, 1 threads", "fast, 1 threads"},
        "presets": {"live", "fast"},
    }
    words = config(f"groups=[{group}]", "presets=[live,fast]")
    with initialize_config_module("sphericalvision.conf", version_base="1.3"):
        rows = measure_speed(words, tmp_path)
    assert all(row.median > 0 for row in rows if row.unit != "MB")
    assert {row.name for row in rows} >= expected[group]
    assert {row.unit for row in rows} == ({"s", "MB", "% of N"} if group == "presets" else {"s"})


def test_variants_stand_side_by_side(tmp_path: Path) -> None:
    rows = measure_speed(config("groups=[variants]", "variants=[icosweepnet,icosweepnet_rt]"), tmp_path)
    assert [row.name for row in rows] == ["icosweepnet", "icosweepnet_rt"]
    assert "icosweepnet: 1,380,224 parameters" in rows[0].note
    paper, real_time = (
        bench_networks.gflop(bench_networks.variant(name, 7, 32))
        for name in ("icosweepnet", "icosweepnet_rt")
    )
    assert paper == pytest.approx(2264, abs=1)  # as counted for the authors' network, every tap
    assert paper / real_time > 20


@pytest.mark.parametrize(
    ("words", "remedy"),
    [
        (["groups=[network,speed]"], r"groups.*network"),
        (["options=[fp8]"], r"options.*layers"),
        (["only=regresion"], r"only: expected a part of a title.*regulariser"),
        (["only='('"], "only: expected a regular expression"),
        (["groups=[variants]", "variants=[icosweepnet_huge]"], "variants.*icosweepnet_rt"),
        (["groups=[variants]", "variants=[sphere_classifier]"], "variants.*'icosweepnet', .*got 'sphere"),
        pytest.param(
            ["device=cuda"],
            "device: expected auto, cpu or cuda, got 'cuda'",
            marks=pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU"),
        ),
    ],
)
def test_mistakes_are_told_and_nothing_is_written(tmp_path: Path, words: list[str], remedy: str) -> None:
    with pytest.raises(ArgumentError, match=remedy):
        measure_speed(config(*words), tmp_path)
    assert not list(tmp_path.iterdir())


def test_what_to_measure_is_found_by_title(tmp_path: Path) -> None:
    rows = measure_speed(config("only='tables|cost'"), tmp_path)
    assert {row.title.partition(": ")[2] for row in rows} == {"sweep tables of a new rig", "cost volume"}


def test_other_libraries_measure_the_same_lens() -> None:
    """Where they answer in pixels, and away from 90°."""
    (runs,) = (
        comparison.runs
        for comparison in bench_cameras.cameras(config(), CPU)
        if comparison.title == "project 50 points, float64"
    )
    compared = 0
    for name, run in runs.items():
        model, _, library = name.rpartition(", ")
        if library in ("OpenCV", "kornia", "ds-msp"):
            pixels, valid = runs[model]()
            answer = run()
            found = torch.as_tensor(answer if isinstance(answer, torch.Tensor) else answer[0]).squeeze()
            near = valid & ((pixels - 400).norm(dim=-1) < 300)
            torch.testing.assert_close(found[near], pixels[near], atol=1e-4, rtol=0)
            compared += 1
    assert compared >= 3
